"""Developed pictures with strong noise, 16 to 24 dB: blind, told and refilled denoisers on photographs.

    python -m benchmarks.strong_pictures FOLDER rawaug-srgb rawaug-srgb@40 ffdnet_color.safetensors@50 \\
        ffdnet_color.safetensors+refill@50 NonLocalMeans@40 BM3D@40 --ahead rawaug-srgb rawaug-srgb@40 \\
        [--count 12] [--crop 256] [--json FILE]

Two kinds of noise are drawn on the middle of each photograph. *Finished* is RAW with the noise of a phone at ISO 3200
(Motorola Nexus 6, Samsung Galaxy S6 Edge), developed and finished by the ranges of ``rawaug.Finish()`` with its JPEG;
the truth is the developed clean RAW, finished alike. *JPEG* is coloured noise with coarse grain on the picture itself,
clipped to [0, 1], then JPEG. Of the draws with keys 0, 1, ... the first with a noisy PSNR between 16 and 24 dB is
taken. Printed are PSNR and SSIM by kind, for all denoisers on the same pictures, and by how many dB those behind
``--ahead`` are ahead of all others, with the 95 % interval over pictures. What stands in the file is not scored again.
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
from rawaug.evaluation.verdict import paired_interval
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
KINDS = "finished", "JPEG"
MOST_DRAWS = 200
"""Draws that are tried for a picture of such noise."""

Scores = dict[str, dict[str, list[list[float]]]]
"""PSNR and SSIM of each picture, by denoiser and kind."""


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
        for kind in KINDS:
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
    options.add_argument("--json", type=Path, help="file of all scores")
    options.add_argument("--ahead", nargs="*", help="whose gains over all others are printed; by default the first's")
    args = options.parse_args(command)

    denoisers = {spec: PictureDenoiser.of(spec) for spec in args.denoisers}
    scores: Scores = {}
    kinds: list[str] = []
    if args.json and args.json.exists():
        scores = json.loads(args.json.read_text(encoding="utf-8"))
    for kind, name, noisy, clean in strong_pairs(args.folder, args.count, args.crop):
        number = kinds.count(kind)
        kinds.append(kind)
        for spec in ("noisy", *args.denoisers):
            rows = scores.setdefault(spec, {}).setdefault(kind, [])
            if len(rows) <= number:
                result = denoisers[spec](Noisy(noisy)) if spec in denoisers else noisy
                rows.append([psnr(result, clean).item(), ssim(result, clean).item()])
        print(kind, name, *(f"{spec} {rows[kind][number][0]:.2f}" for spec, rows in scores.items()), flush=True)
        if args.json:
            args.json.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")

    print_means(scores)
    for spec in args.ahead or args.denoisers[:1]:
        print_differences(scores, spec)


def print_means(scores: Scores) -> None:
    """Print the means of all denoisers."""
    rows = []
    for spec, by_kind in scores.items():
        cells = [spec]
        for kind in KINDS:
            decibels, similarity = zip(*by_kind[kind], strict=True)
            cells.append(f"{fmean(decibels):.2f} / {fmean(similarity):.4f}")
        rows.append(cells)
    print_rows(f"PSNR in dB / SSIM, {len(scores['noisy']['JPEG'])} pictures of each kind", ["", *KINDS], rows)


def print_differences(scores: Scores, spec: str) -> None:
    """Print by how many dB a denoiser is ahead of each other one, picture by picture, and in how many of them."""
    rows = []
    for rival in scores:
        if rival == spec:
            continue
        cells = [rival]
        for kind in KINDS:
            gains = [one[0] - other[0] for one, other in zip(scores[spec][kind], scores[rival][kind], strict=True)]
            low, high = paired_interval(gains)
            ahead = sum(gain > 0 for gain in gains)
            cells.append(f"{fmean(gains):+.2f} ({low:+.2f} to {high:+.2f}), {ahead} of {len(gains)}")
        rows.append(cells)
    print_rows(f"{spec} ahead by, dB (95 % interval), in how many pictures", ["", *KINDS], rows)


if __name__ == "__main__":
    main()
