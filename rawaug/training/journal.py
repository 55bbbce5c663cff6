"""What a training writes while it runs: ``log.csv``, and curves and crops for TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from torch import nn

from rawaug.extras import extra
from rawaug.files import replacing
from rawaug.training.validation import Watched, panels

SHOWN, SHOWINGS = 3, 20
"""Validation frames of which TensorBoard shows crops, and how often at most."""


class Journal:
    """``log.csv`` and TensorBoard's files of a run from ``start`` on; what a killed run logged beyond it is dropped.

    A row has the mean loss since the row before, the validation PSNR, the learning rate of the step and the speed.
    TensorBoard shows the middles of :data:`SHOWN` validation frames besides. A run from its beginning clears what
    another one has left.
    """

    def __init__(self, folder: Path, start: int) -> None:
        with extra("train"):
            from torch.utils.tensorboard.writer import SummaryWriter

        self.path = folder / "log.csv"
        if self.path.is_file():
            head, *rows = self.path.read_text().splitlines(keepends=True)
            kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= start]
            with replacing(self.path) as partial:
                partial.write_text("".join([head, *kept]) if kept else "")
        for events in folder.glob("events.out.tfevents.*") if not start else ():
            events.unlink()
        self.next_shown = 0
        self.writer = SummaryWriter(str(folder), purge_step=start + 1 if start else None)

    def log(self, step: int, **values: float) -> None:
        """One row in the CSV file and one point in each TensorBoard curve."""
        head = ["step", *values]
        known = self.path.read_text().splitlines() if self.path.is_file() else []
        if known and known[0] != ",".join(head):  # begun by a version with other columns
            write_rows(self.path, head, list(csv.DictReader(known)))
        with self.path.open("a", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            if not known:
                rows.writerow(head)
            rows.writerow([step, *(f"{value:.6g}" for value in values.values())])
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def show(self, step: int, steps: int, net: nn.Module, frames: Sequence[Watched]) -> None:
        """Noisy, denoised and clean crops in TensorBoard, at most :data:`SHOWINGS` times in ``steps``."""
        if self.next_shown <= step:
            self.next_shown = step + steps // SHOWINGS
            for k, frame in enumerate(frames[:SHOWN]):
                self.writer.add_image(f"noisy_denoised_clean/{k}", panels(net, frame), step)

    def close(self) -> None:
        """Write what is left."""
        self.writer.close()


def write_rows(path: Path, head: Sequence[str], rows: Sequence[dict[str, str]]) -> None:
    """A CSV file with the columns ``head``; what a row lacks is empty, what ``head`` lacks is left out."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, head, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
