r"""What augmentation is worth to a network that is solved, not trained: ``python -m benchmarks.augmentation PHOTOS``.

A patch p of 7 x 7 x 4 stabilised, packed RAW, less the mean of each plane, has the features
:math:`\phi(p) = (\operatorname{relu}(W p + b), p, 1)` with W and b drawn once (Rahimi and Recht, "Random Features for
Large-Scale Kernel Machines", NIPS 2007). Ridge regression to the clean centre,

.. math:: B = (G + \lambda \bar g I)^{-1} c, \quad G = \operatorname{mean} \phi \phi^T, \quad
    c = \operatorname{mean} \phi\, t^T, \quad \bar g = \operatorname{tr} G / n,

has one solution, so that neither steps nor learning rates play a part. A mixture of sources is a weighted sum of their
G and c; :math:`\lambda` is the best one on validation frames.

Rows are paired differences from the real pairs alone, with standard errors over test frames. The row ``more pairs`` is
the ceiling: if true pairs do not gain :data:`HEADROOM` there, no augmentation can, and the table says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean, stdev

import torch
from torch import Tensor

from benchmarks.measure import parser
from denoisers.domains import DOMAINS, fit_levels
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.pairs import Pair, Sample
from rawaug.data.selection import select_pairs
from rawaug.evaluation.trials import make_trial
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.seeding import keyed_generator
from rawaug.training.sources import OwnPictureCrops, PictureCrops, RealCrops, Source

SIDE = 7
CROP = 64
PATCHES = 20
"""This many patches are taken from a crop."""
SHARE = 0.75
"""Share of the samples that do not come from the real pairs."""
HEADROOM = 0.2
"""Least gain in dB of more true pairs for a column to decide anything; it also has to be two standard errors."""
RIDGES = (1e-4, 1e-3, 1e-2, 3e-2)
PHONES = ["iPhone 7", "Google Pixel", "Samsung Galaxy S6 Edge", "Motorola Nexus 6", "LG G4"]
"""The noise of the frames, at any of its ISOs."""
LENS = 0.6
"""Deviation in pixels of the lens of the frames."""
STABILISED = DOMAINS["anscombe"]

Moments = tuple[Tensor, Tensor]
"""G and c of a source of samples."""


class Features:
    """The features of patches, and what is made of them; all draws come from ``seed``."""

    def __init__(self, count: int, seed: int) -> None:
        generator = keyed_generator(seed, "features")
        inputs = 4 * SIDE * SIDE
        self.weights = torch.randn(inputs, count, generator=generator) * 2.0 / math.sqrt(inputs)
        self.bias = torch.randn(count, generator=generator)

    def __call__(self, patches: Tensor) -> Tensor:
        """Compute the features ``(N, F)`` of patches ``(N, 196)``."""
        scaled = patches / 3.0
        hidden = torch.relu(scaled @ self.weights + self.bias)
        return torch.cat([hidden, scaled, torch.ones(len(scaled), 1)], dim=1)


def cut_patches(sample: Sample, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut patches out of a sample of ``(4, h, w)``: patches less their means, targets, means, and clean centres.

    Returns:
        Stabilised ``(N, 196)``, ``(N, 4)`` and ``(N, 4)``, and RAW ``(N, 4)``.
    """
    levels = fit_levels(sample.noisy[None], sample.variance[None])
    noisy = STABILISED.forward(sample.noisy[None], *levels)[0]
    clean = STABILISED.forward(sample.clean[None], *levels)[0]

    height, width = noisy.shape[-2:]
    row = torch.randint(height - SIDE + 1, (count,), generator=generator)
    column = torch.randint(width - SIDE + 1, (count,), generator=generator)
    windows = noisy.unfold(1, SIDE, 1).unfold(2, SIDE, 1)[:, row, column].transpose(0, 1)

    centre = SIDE // 2
    mean = windows.mean((2, 3))
    target = clean[:, row + centre, column + centre].T - mean
    patches = (windows - mean[:, :, None, None]).reshape(count, -1)
    return patches, target, mean, sample.clean[:, row + centre, column + centre].T


def measure_moments(features: Features, source: Source, samples: int, key: str, seed: int) -> Moments:
    """Average G ``(F, F)`` and c ``(F, 4)`` over about so many patches of a source."""
    crops = math.ceil(samples / PATCHES)
    gram, cross = torch.zeros(()), torch.zeros(())

    for first in range(0, crops, 100):
        generators = [keyed_generator(seed, key, k) for k in range(first, min(first + 100, crops))]
        drawn = [source.draw(generator) for generator in generators]
        cuts = [cut_patches(sample, PATCHES, one) for sample, one in zip(drawn, generators, strict=True)]
        phi = features(torch.cat([cut[0] for cut in cuts]))
        gram = gram + phi.T @ phi
        cross = cross + phi.T @ torch.cat([cut[1] for cut in cuts])

    return gram / (crops * PATCHES), cross / (crops * PATCHES)


class TestFrames:
    """Patches of the middles of frames, the same for every row."""

    def __init__(self, features: Features, frames: Sequence[Pair], patches: int) -> None:
        self.parts = []
        for number, pair in enumerate(frames):
            trial = make_trial(pair.middle(256).with_levels(), noise_model((0.0, 0.0)), CFA.RGGB)
            assert trial.variance is not None
            sample = Sample(trial.noisy[0], trial.clean[0], trial.variance[0])
            cut, _, mean, clean = cut_patches(sample, patches, keyed_generator(0, "test patches", number))
            self.parts.append((features(cut), mean, clean, fit_levels(trial.noisy, trial.variance)))

    def score(self, solution: Tensor) -> list[float]:
        """Compute the PSNR of every frame."""
        scores = []
        for phi, mean, clean, levels in self.parts:
            denoised = STABILISED.inverse((phi @ solution + mean).T[None, :, None], *levels)[0, :, 0].T
            scores.append(psnr(denoised[None], clean[None]).item())
        return scores


def solve(real: Moments, other: Moments | None, validation: TestFrames) -> Tensor:
    """Solve for the weights ``(F, 4)`` of a mixture, with the ridge that is best on the validation frames."""
    gram, cross = real
    if other is not None:
        gram = (1.0 - SHARE) * real[0] + SHARE * other[0]
        cross = (1.0 - SHARE) * real[1] + SHARE * other[1]

    solutions = []
    for ridge in RIDGES:
        penalty = ridge * gram.diagonal().mean() * torch.eye(len(gram))
        solutions.append(torch.linalg.solve(gram + penalty, cross))
    return max(solutions, key=lambda solution: fmean(validation.score(solution)))


def difference(scores: Sequence[float], base: Sequence[float]) -> tuple[float, float]:
    """Compute the mean of paired differences and its standard error."""
    differences = [one - other for one, other in zip(scores, base, strict=True)]
    return fmean(differences), stdev(differences) / math.sqrt(len(differences))


def sources(
    pairs: Sequence[Pair], more: Sequence[Pair], pictures: Sequence[Tensor], isp: DictionaryISP
) -> Mapping[str, Source]:
    """Make the sources of samples that join the real pairs, by row."""
    noise = noise_model(PHONES)

    def augment(draw: Draw) -> RawAugment:
        return RawAugment(isp, noise, draw=draw)

    def of_pictures(draw: Draw) -> Source:
        return PictureCrops(RawPairs(pictures, augment(draw), CROP))

    sharp, soft = Draw(sampling="perturb", blur=0.0), Draw(sampling="perturb", blur=LENS)
    without_noise = [replace(pair, noisy=None) for pair in pairs]
    return {
        "more pairs (the ceiling)": RealCrops(more, noise, CROP, isp.cfa),
        "the same frames, fresh noise": RealCrops(without_noise, noise, CROP, isp.cfa),
        "own pictures": OwnPictureCrops(pairs, augment(sharp), CROP),
        "soft pictures": of_pictures(soft),
        "soft pictures, mixtures of atoms": of_pictures(Draw(blur=LENS)),
        "sharp pictures": of_pictures(sharp),
        "sharp pictures, mixtures of atoms": of_pictures(Draw(blur=0.0)),
    }


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("photographs", nargs="?", default="", help="a folder of photographs; by default the package's six")
    cli.add_argument("--isp", default="phones", help="a shipped ISP, a file, or fit: one fitted to the pairs")
    cli.add_argument("--features", type=int, default=400)
    cli.add_argument("--samples", type=int, default=8000, help="patches of each source")
    cli.add_argument("--count", type=int, default=5, help="number of real pairs, one of each phone in turn")
    cli.add_argument("--more", type=int, default=56, help="number of pairs of the ceiling, whole scenes")
    cli.add_argument("--test", type=int, default=20, help="number of test frames")
    cli.add_argument("--seed", type=int, default=0)
    options = cli.parse_args()
    torch.set_num_threads(1)

    data = f"phones:{options.photographs}"
    train, validation, test = (open_pairs(data, split) for split in ("train", "validation", "test"))
    whole = [train[k] for k in select_pairs(train, len(train), options.count, "phones")]
    more = [train[k] for k in select_pairs(train, len(train), options.more, "scenes")]
    folder = f"{options.photographs}/train" if options.photographs else "demo:"
    pictures = open_pictures(folder, CROP)

    features = Features(options.features, options.seed)
    tuned = TestFrames(features, [validation[k] for k in range(10)], 400)
    scored = TestFrames(features, [test[k] for k in range(options.test)], 800)

    for title, side in (("middles of 96", 96), ("whole frames", None)):
        pairs = whole if side is None else [pair.middle(side) for pair in whole]
        isp = fit_isp(pairs, FitConfig(method="published", steps=60, joint_steps=400)) if options.isp == "fit" else None
        isp = isp or DictionaryISP.from_pretrained(options.isp)
        noise = noise_model((0.0, 0.0))
        real = measure_moments(features, RealCrops(pairs, noise, CROP, isp.cfa), options.samples, "real", options.seed)
        base = scored.score(solve(real, None, tuned))
        print(f"\n{options.count} pairs, {title}, ISP {options.isp}: the pairs alone {fmean(base):.2f} dB", flush=True)

        decides = True
        for name, source in sources(pairs, more, pictures, isp).items():
            moments = measure_moments(features, source, options.samples, name, options.seed)
            gain, error = difference(scored.score(solve(real, moments, tuned)), base)
            line = f"{name:36} {gain:+.2f} +- {error:.2f}"
            if name.startswith("more"):
                decides = gain > max(HEADROOM, 2.0 * error)
            elif not decides:
                line += "   cannot decide: more true pairs gain no more"
            print(line, flush=True)


if __name__ == "__main__":
    main()
