"""The first picture of the README: a photograph, the RAW that the plugin makes of it, and that RAW denoised.

    python -m benchmarks.overview docs/overview.jpg

The photograph is a built-in one. RAW is shown as the sensor has it, without white balance, through the sRGB curve;
inset, 16 x 16 of its sites, each in its colour.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

import denoisers
import rawaug
from benchmarks.measure import parser
from rawaug import bayer
from rawaug.data.demo import demo_files
from rawaug.io import encode_srgb, read_picture
from rawaug.metrics import psnr
from rawaug.noise import noise_model

PICTURE, PLACE, SIDE = "astronaut", (0, 60), 300
CAMERA, ISO = "Sony ILCE-7M3", 51200
SITES, INSET, INSIDE = 16, 80, (140, 130)
"""Sites on the side of the inset, its side in the figure, and where it is taken."""


@torch.no_grad()
def panels() -> dict[str, Tensor]:
    """Titled pictures ``(3, SIDE, SIDE)`` in [0, 1]."""
    file = next(file for file in demo_files() if file.stem == PICTURE)
    srgb = read_picture(file)[:, PLACE[0] : PLACE[0] + SIDE, PLACE[1] : PLACE[1] + SIDE]
    noise = noise_model({"name": CAMERA, "settings": {"iso": ISO}})
    augment = rawaug.RawAugment.from_pretrained(
        "universal", noise, camera=CAMERA, draw=rawaug.Draw(light=5500, exposure=0.0)
    )
    pair = augment(srgb[None], generator=torch.Generator().manual_seed(0))
    model = denoisers.from_pretrained("rawaug-small")
    denoised = model(pair.noisy, pair.variance).clamp(max=1.0)
    before, after = (psnr(x, pair.clean).item() for x in (pair.noisy, denoised))
    sensor = bayer.pattern(str(augment.cfa))

    def shown(packed: Tensor) -> Tensor:
        mosaic = bayer.unpack(packed, augment.cfa)
        picture = encode_srgb(sensor.demosaic(mosaic)[0].clamp(0, 1))
        (top, left), enlarged = INSIDE, INSET // SITES
        sites = mosaic[0, :, top : top + SITES, left : left + SITES] * sensor.planes(SITES, SITES)
        inset = (
            encode_srgb((sites / sites.max()).clamp(0, 1)).repeat_interleave(enlarged, 1).repeat_interleave(enlarged, 2)
        )
        picture[:, -INSET - 2 :, : INSET + 2] = 1.0
        picture[:, -INSET:, :INSET] = inset
        return picture

    finished = augment.isp.forward_pixels(sensor.demosaic(bayer.unpack(denoised, augment.cfa)), pair.params.isp)
    return {
        "an sRGB picture": srgb / 255.0,
        f"clean RAW of a {CAMERA}": shown(pair.clean),
        f"noisy RAW, ISO {ISO:,}: {before:.1f} dB": shown(pair.noisy),
        f"denoised, developed: {after:.1f} dB": finished[0].clamp(0, 1),
    }


def main(argv: list[str] | None = None) -> None:
    from matplotlib.figure import Figure

    cli = parser(__doc__)
    cli.add_argument("out", type=Path)
    out = cli.parse_args(argv).out
    shown = panels()
    figure = Figure(figsize=(3.1 * len(shown), 3.4), layout="constrained")
    for axes, (title, image) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        axes.imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.axis("off")
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
