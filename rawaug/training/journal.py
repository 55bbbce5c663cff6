"""The log of a training, ``log.csv``."""

from __future__ import annotations

import csv
from pathlib import Path

from rawaug.files import replacing


class Journal:
    """The log of a training, ``log.csv``.

    A row has the mean loss since the previous row, the validation PSNR, the learning rate of the step and the speed.

    Args:
        folder: folder of this file. A training that begins at its first step clears what another one has left there.
        start: the step from which the training goes on; rows that a killed training wrote beyond it are dropped.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self.path = folder / "log.csv"
        if self.path.is_file():
            self._drop_rows_after(start)

    def _drop_rows_after(self, step: int) -> None:
        """Write the file anew without the rows of later steps."""
        head, *rows = self.path.read_text().splitlines(keepends=True)
        earlier = []
        for row in rows:
            is_whole = row.endswith("\n")  # a killed training may have cut its last row short
            if is_whole and int(row.split(",")[0]) <= step:
                earlier.append(row)

        text = ""
        if earlier:
            text = "".join([head, *earlier])
        with replacing(self.path) as partial:
            partial.write_text(text)

    def log(self, step: int, **values: float) -> None:
        """Write a row."""
        is_empty = not self.path.is_file() or not self.path.stat().st_size
        with self.path.open("a", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            if is_empty:
                rows.writerow(["step", *values])
            rows.writerow([step, *[f"{value:.6g}" for value in values.values()]])
