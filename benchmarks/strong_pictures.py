"""Developed pictures with strong noise, 16 to 24 dB: blind, told and refilled denoisers on photographs.

    python -m benchmarks.strong_pictures FOLDER rawaug-srgb rawaug-srgb@40 ffdnet_color.safetensors@50 \\
        ffdnet_color.safetensors+refill@50 NonLocalMeans@40 BM3D@40 [--count 12] [--crop 256] [--json FILE]

Two kinds of noise are drawn on the middle of each photograph. *Finished* is RAW with the noise of a phone at ISO 3200
(Motorola Nexus 6, Samsung Galaxy S6 Edge), developed and finished by the ranges of ``rawaug.Finish()`` with its JPEG;
the truth is the developed clean RAW, finished alike. *JPEG* is coloured noise with coarse grain on the picture itself,
clipped to [0, 1], then JPEG. Of the draws with keys 0, 1, ... the first with a noisy PSNR between 16 and 24 dB is
taken. Printed are PSNR and SSIM by kind, for all denoisers on the same pictures.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

from torch import Tensor

from benchmarks.measure import parser
from rawaug.data import open_pictures
from rawaug.data.pairs import centre
from rawaug.denoising.denoiser import Noisy
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.tables import print_rows
from rawaug.isp.functional import as_float
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr, ssim
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.finishing import Finish
from rawaug.plugin.targets import Srgb
from rawaug.seeding import keyed_generator
from rawaug.training.srgb_noise import ColouredNoise

PHONES = [{"name": "Motorola Nexus 6", "iso": 3200}, {"name": "Samsung Galaxy S6 Edge", "iso": 3200}]
NOISIEST, CLEANEST = 16.0, 24.0
MOST_DRAWS = 200
"""Draws that are tried for a picture of such noise."""


def strong_pairs(folder: str, count: int, crop: int) -> Iterator[tuple[str, str, Tensor, Tensor]]:
    """Draw (kind, name, noisy, clean), sRGB ``(1, 3, crop, crop)``, of evenly spread pictures of a folder."""
    pictures = open_pictures(folder, crop)
    augment = RawAugment(
        DictionaryISP.from_pretrained("universal"), noise_model(PHONES), target=Srgb(finish=Finish(), shots=0)
    )
    coloured = ColouredNoise(sigma=75.0, coloured=1.0, blur=(0.3, 1.5), jpeg=(75, 95), wide=0.9)

    step = max(1, len(pictures) // count)
    for number in range(0, step * count, step):
        picture = centre(pictures[number], crop, crop)
        for kind in ("finished", "JPEG"):
            for draw in range(MOST_DRAWS):
                generator = keyed_generator("strong pictures", kind, number, draw)
                if kind == "finished":
                    pair = augment(picture, generator)
                    noisy, clean = pair.noisy[None], pair.clean[None]
                else:
                    clean = as_float(picture)[None]
                    noisy = coloured.apply(clean, coloured.sample(1, generator))
                if NOISIEST <= psnr(noisy, clean).item() <= CLEANEST:
                    yield kind, f"{number}", (255.0 * noisy).round() / 255.0, clean
                    break


def main(command: Sequence[str] | None = None) -> None:
    """Draw the pictures, denoise them by everything that is named, and print the means."""
    options = parser(__doc__)
    options.add_argument("folder", help="photographs without noise")
    options.add_argument("denoisers", nargs="+")
    options.add_argument("--count", type=int, default=12, help="photographs")
    options.add_argument("--crop", type=int, default=256)
    options.add_argument("--json", type=Path, help="write all scores to this file")
    args = options.parse_args(command)

    denoisers = {spec: PictureDenoiser.of(spec) for spec in args.denoisers}
    scores: dict[str, dict[str, list[list[float]]]] = {}
    for kind, name, noisy, clean in strong_pairs(args.folder, args.count, args.crop):
        results = {"noisy": noisy} | {spec: denoiser(Noisy(noisy)) for spec, denoiser in denoisers.items()}
        for spec, result in results.items():
            row = [psnr(result, clean).item(), ssim(result, clean).item()]
            scores.setdefault(spec, {}).setdefault(kind, []).append(row)
        print(kind, name, *(f"{spec} {rows[kind][-1][0]:.2f}" for spec, rows in scores.items()), flush=True)
        if args.json:
            args.json.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")

    rows = []
    for spec, by_kind in scores.items():
        cells = [spec]
        for kind in ("finished", "JPEG"):
            decibels, similarity = zip(*by_kind[kind], strict=True)
            cells.append(f"{fmean(decibels):.2f} / {fmean(similarity):.4f}")
        rows.append(cells)
    print_rows(
        f"PSNR in dB / SSIM, {len(scores['noisy']['JPEG'])} pictures of each kind", ["", "finished", "JPEG"], rows
    )


if __name__ == "__main__":
    main()
