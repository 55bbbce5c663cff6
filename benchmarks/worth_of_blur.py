"""What softness of published cameras is worth on real frames: ``python -m benchmarks.worth_of_blur PHOTOS SETS``.

The denoiser is that of :mod:`benchmarks.augmentation`, random features solved by ridge regression, so that no training
is involved. It learns from RAW of photographs that ``universal`` makes, blurred by nothing, by the range
:data:`rawaug.camera.softness.PUBLISHED`, or by its middle; it is tested on real frames with drawn noise of the four
strengths of ``rawaug benchmark``. A set is named as for :mod:`benchmarks.strengths`: ``@4`` bins it 4 x 4, which makes
frames as sharp as photographs for the screen. Figures are dB above no blur, each by seed of the features.
"""

from __future__ import annotations

from statistics import fmean

import torch

from benchmarks.augmentation import CROP, STABILISED, Features, cut_patches, measure_moments
from benchmarks.measure import parser
from denoisers.domains import fit_levels
from rawaug import bayer
from rawaug.camera.softness import PUBLISHED
from rawaug.data import open_pairs, open_pictures
from rawaug.data.pairs import Sample
from rawaug.evaluation.benchmark import STRENGTHS
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.seeding import keyed_generator
from rawaug.training.sources import PictureCrops, add_noise

RIDGE = 1e-3
MIDDLE = 1024
"""Largest side of the middle of a frame, in pixels, from which patches are taken."""
BLURS: dict[str, tuple[float, float] | float] = {"none": 0.0, "published": PUBLISHED, "middle": sum(PUBLISHED) / 2.0}


def noisy_sets(specs: list[str]) -> dict[tuple[str, str], list[Sample]]:
    """Make the middles of all frames of the sets, by set and strength."""
    samples: dict[tuple[str, str], list[Sample]] = {}
    for spec in specs:
        data, _, factor = spec.partition("@")
        for pair in open_pairs(data, bin=int(factor or 1)):
            packed = bayer.pack(pair.middle(MIDDLE).clean.mosaic[None], pair.cfa)
            for strength, levels in STRENGTHS.items():
                generator = keyed_generator(0, "worth of blur", pair.name, strength)
                samples.setdefault((spec, strength), []).append(add_noise(packed, noise_model(levels), generator))
    return samples


def score(solution: torch.Tensor, features: Features, samples: list[Sample], patches: int) -> float:
    """Compute the PSNR of the solved denoiser on patches of samples, averaged over them."""
    scores = []
    for number, sample in enumerate(samples):
        cut, _, mean, clean = cut_patches(sample, patches, keyed_generator(0, "test patches", number))
        levels = fit_levels(sample.noisy[None], sample.variance[None])
        denoised = STABILISED.inverse((features(cut) @ solution + mean).T[None, :, None], *levels)[0, :, 0].T
        scores.append(psnr(denoised[None], clean[None]).item())
    return fmean(scores)


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("photographs", help="a folder of photographs")
    cli.add_argument("sets", nargs="+")
    cli.add_argument("--features", type=int, default=400)
    cli.add_argument("--samples", type=int, default=8000, help="patches of each blur")
    cli.add_argument("--patches", type=int, default=4000, help="patches of each test frame")
    cli.add_argument("--seeds", type=int, default=3)
    options = cli.parse_args()
    torch.set_num_threads(1)

    pictures = open_pictures(options.photographs, CROP)
    isp = DictionaryISP.from_pretrained("universal")
    noise = noise_model("cycleisp_sidd")
    sets = noisy_sets(options.sets)
    rows: dict[tuple[str, str], dict[str, list[float]]] = {key: {} for key in sets}
    for seed in range(options.seeds):
        features = Features(options.features, seed)
        for name, blur in BLURS.items():
            source = PictureCrops(RawPairs(pictures, RawAugment(isp, noise, draw=Draw(blur=blur)), CROP))
            gram, cross = measure_moments(features, source, options.samples, "pictures", seed)
            solution = torch.linalg.solve(gram + RIDGE * gram.diagonal().mean() * torch.eye(len(gram)), cross)
            for key, samples in sets.items():
                rows[key].setdefault(name, []).append(score(solution, features, samples, options.patches))

    for (spec, strength), scores in rows.items():
        line = f"{spec.rstrip('/').rpartition('/')[2]:20} {strength:12} none {fmean(scores['none']):.2f} dB"
        for name in ("published", "middle"):
            gains = [one - none for one, none in zip(scores[name], scores["none"], strict=True)]
            line += f"   {name} {fmean(gains):+.2f} (" + ", ".join(f"{gain:+.2f}" for gain in gains) + ")"
        print(line, flush=True)


if __name__ == "__main__":
    main()
