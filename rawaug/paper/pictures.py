"""The pictures of the paper's page: RAW of one frame by every method, and several RAWs of its one picture.

RAW is demosaiced and shown by the curve of sRGB without white balance or matrix, all of a frame at one exposure. So
light that methods place differently can be seen, as greenish as it is.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.figures import detail_window
from rawaug.files import write_bytes
from rawaug.io.pictures import encode_png, encode_srgb
from rawaug.isp.functional import frame_coordinates
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import draw_setting
from rawaug.paper.methods import Method, raw_maker, settings
from rawaug.seeding import keyed_generator

SIDE = 256
"""Largest side of a picture in pixels: the part of the frame that has most detail."""

SAMPLES = 6
"""Number of RAWs that are drawn of one picture."""

_BRIGHT = 0.9
"""The brightest hundredth of the frame's RAW is shown at this share of white."""


@torch.no_grad()
def draw_frame(family: str, model: Method, pair: Pair, folder: Path) -> None:
    """Write ``RGB.png``, ``RAW.png`` and ``FAMILY.png``, and ``FAMILY-samples.png`` of a dictionary ISP.

    Args:
        family: name of the method.
        model: the fitted method.
        pair: a frame that it has not seen.
        folder: where the pictures go.
    """
    packed = bayer.pack(pair.clean.mosaic[None], pair.cfa)
    _, rows, columns = detail_window(packed, SIDE // 2)
    top, left = 2 * rows.start, 2 * columns.start
    patch = pair.srgb[None, :, top : top + SIDE, left : left + SIDE]
    raw = pair.clean.mosaic[None, :, top : top + SIDE, left : left + SIDE]
    (height, width), (frame_height, frame_width) = patch.shape[-2:], pair.clean.mosaic.shape[-2:]
    place = frame_coordinates(height, width, (top, left), (frame_height, frame_width))

    exposure = _BRIGHT / raw.quantile(0.99).clamp_min(1e-4)
    write_bytes(encode_png(patch[0].float() / 255.0), folder / "RGB.png")
    write_bytes(encode_png(show_raw(raw * exposure, pair.cfa)[0]), folder / "RAW.png")

    blind = settings(model, pair)["blind"]
    made = raw_maker(model, blind)(patch, place).clamp(0.0, 1.0)
    write_bytes(encode_png(show_raw(made * exposure, pair.cfa)[0]), folder / f"{family}.png")
    if not isinstance(model, DictionaryISP):
        return

    drawn = draw_setting(model, SAMPLES, keyed_generator("samples of one picture"))
    samples = model.reverse(patch.expand(SAMPLES, -1, -1, -1), drawn, coordinates=place).raw
    shown = show_raw(samples * exposure, pair.cfa)
    strip = torch.cat(list(F.avg_pool2d(shown, 2)), dim=-1)
    write_bytes(encode_png(strip), folder / f"{family}-samples.png")


def show_raw(mosaics: Tensor, cfa: CFA) -> Tensor:
    """Make mosaics ``(B, 1, H, W)``, white = 1, pictures ``(B, 3, H, W)`` in [0, 1]."""
    return encode_srgb(bayer.demosaic(mosaics, cfa, "malvar").clamp(0.0, 1.0))
