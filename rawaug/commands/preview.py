"""``rawaug preview``: the stages of an ISP on a picture, and augmented RAWs of it.

Linear images are shown through the sRGB curve. RAW is bilinearly demosaiced and shown without white balance: greenish,
as a sensor sees it. The drawn RAWs are clean and all developed alike, by the ISP's forward pass under the setting that
it chooses for the picture, so they differ only by camera, light, tone and exposure.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import pattern
from rawaug.evaluation.figures import FIGURE_FORMATS, new_figure, save_figure
from rawaug.explore.views import stage_pictures
from rawaug.files import require_output
from rawaug.io.pictures import MAX_PIXELS
from rawaug.io.shots import read_shot
from rawaug.isp.functional import frame_coordinates
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.pictures import trim_to_even
from rawaug.seeding import keyed_generator

_MAXIMUM = 768
"""A previewed picture has at most this side; larger ones are cropped at the centre."""


def run(
    picture: str,
    /,
    *,
    out: str,
    isp: str = "universal",
    count: int = 8,
    seed: int = 0,
    cfa: str | None = None,
    max_pixels: int = MAX_PIXELS,
    overwrite: bool = False,
) -> None:
    """Draw a picture at every stage of an ISP, and as augmented RAW.

    Args:
        picture: an sRGB picture, or a RAW file, which LibRaw develops.
        out: the figure to write, a .png, .jpg, .pdf or .svg.
        isp: ISP file, or the name of a shipped ISP.
        count: number of augmented RAWs to plot.
        seed: random seed of the augmented RAWs.
        cfa: pattern of the RAW: RGGB, BGGR, GRBG, GBRG, XTRANS, or QUAD-RGGB and the like; the ISP's by default.
        max_pixels: a larger picture is refused before it is decoded.
        overwrite: replace the output file if it exists.
    """
    if count < 0:
        raise ValueError(f"count must be at least 0, got {count}")
    path = Path(out)
    if not path.suffix:
        path = Path(f"{out}.png")
    require_output(path, overwrite, FIGURE_FORMATS, [picture])

    augment = RawAugment.from_pretrained(isp, cfa=cfa)
    srgb = trim_to_even(read_shot(picture, max_pixels))
    save_figure(_draw_stages(augment, srgb, count, seed), path)
    print(path)


@torch.no_grad()
def _draw_stages(augment: RawAugment, whole: Tensor, count: int, seed: int) -> Any:
    isp, sensor = augment.isp, pattern(augment.cfa)
    frame = whole.shape[-2], whole.shape[-1]
    height, width = min(frame[0], _MAXIMUM), min(frame[1], _MAXIMUM)
    top, left = (frame[0] - height) // 4 * 2, (frame[1] - width) // 4 * 2
    srgb = bayer.crop(whole, top, left, height, width)
    coordinates = frame_coordinates(height, width, (top, left), frame)
    setting = isp.reverse(srgb[None], coordinates=coordinates).params
    panels = stage_pictures(augment, srgb, setting, coordinates)

    generator = keyed_generator(seed, "preview")
    for k in range(count):
        params = augment.sample(srgb[None], generator, torch.tensor([[top, left, *frame, 0]]))
        pair = augment.apply(srgb[None], params)
        gains = "{:.2f} {:.2f} {:.2f}".format(*pair.params.isp.gains[0].tolist())
        developed = isp.stages.forward(sensor.demosaic(augment.mosaic(pair.clean)), setting).clamp(0, 1)
        panels[f"draw {k + 1}: gains {gains}\nmean {pair.clean.mean().item():.3f}"] = developed[0]

    columns = max(len(panels) - count, 4)
    rows = math.ceil(len(panels) / columns)
    figure = new_figure(2.6 * columns, 2.6 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for axis in axes:
        axis.set_axis_off()
    for axis, (title, image) in zip(axes, panels.items(), strict=False):
        axis.imshow(image.permute(1, 2, 0).numpy())
        axis.set_title(title, fontsize=9)
    return figure
