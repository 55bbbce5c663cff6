"""The picture of the front page: the shadows of a photograph, made brighter, before and after; its noise is its own.

    python -m benchmarks.shadows s40_0117.crw --place 604 1404 --out docs/shadows.jpg

Left, a square of the frame at 100 %, ``--stops`` brighter than it was shot; right, the same denoised with the levels
that ``rawaug denoise`` reads. Both are developed alike, and nothing but the denoiser removes noise. Together they are
as wide as a column of text, so that a page shows them pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measure import parser
from rawaug import bayer
from rawaug.data.development import render_raw
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.levels import find_levels
from rawaug.io import RawFrame, read_raw, write_picture

SIDE, MARGIN, GAP = 356, 134, 8


def picture(frame: RawFrame, mosaic: Tensor, stops: float) -> Tensor:
    """A mosaic ``(1, H, W)`` developed with the frame's colours, sRGB ``(3, H, W)``."""
    return render_raw(mosaic, frame.cfa, frame.white_balance, frame.color_matrix, "ahd", 2.0**stops, None)


def main(command: Sequence[str] | None = None) -> None:
    cli = parser(__doc__)
    cli.add_argument("frame", type=Path)
    cli.add_argument("--place", type=int, nargs=2, required=True, metavar=("TOP", "LEFT"))
    cli.add_argument("--stops", type=float, default=2.0)
    cli.add_argument("--denoiser", default="rawaug-base")
    cli.add_argument("--out", type=Path, required=True)
    args = cli.parse_args(command)
    frame = read_raw(args.frame)
    shot_var, read_var, source = find_levels(frame)
    print(f"{frame.name}: {frame.camera}, shot_var {shot_var:.3g}, read_var {read_var:.3g} ({source})")
    top, left = (at // 2 * 2 for at in args.place)
    rows, columns = (slice(at - MARGIN, at + SIDE + MARGIN) for at in (top, left))
    noisy = bayer.pack(frame.mosaic[None, :, rows, columns], frame.cfa)
    clean = RawDenoiser.of(args.denoiser)(Noisy.of(noisy, (shot_var, read_var), frame.cfa)).clamp(max=1.0)
    pieces = [picture(frame, bayer.unpack(x, frame.cfa)[0], args.stops) for x in (noisy, clean)]
    inner = [piece[:, MARGIN:-MARGIN, MARGIN:-MARGIN] for piece in pieces]
    gap = torch.ones(3, SIDE, GAP)
    shown = torch.cat([inner[0], gap, inner[1]], dim=2)
    write_picture(args.out, (shown.clamp(0, 1) * 255).round().to(torch.uint8))


if __name__ == "__main__":
    main()
