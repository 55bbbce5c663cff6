r"""What the grain costs in PSNR that ``rawaug denoise --strength auto`` leaves in a RAW frame.

    python -m benchmarks.grain rawaug-base --sets real:test real:validation

With noise of levels (shot_var, read_var), a share s of it is removed, so that grain of 1 % of mid grey m stays:

.. math:: s = \max(0, 1 - 0.01 / d), \qquad d = \sqrt{\mathrm{shot\_var}\, m + \mathrm{read\_var}} / m .

Frames, strengths and noise are those of ``benchmarks.strengths``, levels told. A row has d, s, RAW / developed PSNR at
s = 1 and at this s, and the mean loss in RAW with its 95 % interval over frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import torch

from benchmarks.measure import parser
from benchmarks.strengths import frozen_trials
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.raw import GRAIN, MID_GREY
from rawaug.evaluation.benchmark import STRENGTHS
from rawaug.evaluation.scores import Row, score
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.verdict import paired_interval


def main(command: Sequence[str] | None = None) -> None:
    """Score the denoiser at full strength and with grain, and print a row for each strength of noise."""
    options = parser(__doc__)
    options.add_argument("denoiser")
    options.add_argument("--sets", nargs="+", default=["real:test", "real:validation"])
    options.add_argument("--crop", type=int, default=256, help="side of the middles, in pixels of the mosaic")
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = options.parse_args(command)
    torch.set_num_threads(args.threads)

    denoiser = RawDenoiser.of(args.denoiser)
    shares = {name: share_removed(*levels) for name, levels in STRENGTHS.items()}
    scores: dict[str, list[tuple[Row, Row]]] = {name: [] for name in STRENGTHS}
    for name in args.sets:
        for trial in frozen_trials(name, args.crop):
            with_grain = replace(denoiser, name="with grain", strength=shares[trial.strength])
            whole, grainy = score([denoiser, with_grain], [trial])
            scores[trial.strength].append((whole, grainy))

    rows = []
    for name, frames in scores.items():
        losses = [whole.psnr - grainy.psnr for whole, grainy in frames]
        low, high = paired_interval(losses)
        cells = []
        for column in zip(*frames, strict=True):
            raw, srgb = fmean(row.psnr for row in column), fmean(row.psnr_srgb or 0.0 for row in column)
            cells.append(f"{raw:.2f} / {srgb:.2f}")
        noise = GRAIN / (1.0 - shares[name])
        loss = f"{fmean(losses):.2f} ({low:.2f} to {high:.2f})"
        rows.append([name, f"{noise:.1%}", f"{shares[name]:.2f}", *cells, loss])
    print_rows("PSNR in dB", ["strength", "d", "s", "s = 1", "with grain", "loss in RAW"], rows)


def share_removed(shot_var: float, read_var: float) -> float:
    """The share s of the noise that is removed at these levels."""
    deviation = math.sqrt(shot_var * MID_GREY + read_var) / MID_GREY
    return max(0.0, 1.0 - GRAIN / deviation)


if __name__ == "__main__":
    main()
