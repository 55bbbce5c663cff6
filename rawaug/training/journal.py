"""The log of a training, ``log.csv``."""

from __future__ import annotations

from pathlib import Path

from rawaug.files import write_text


class Journal:
    """The log of a training, ``log.csv``.

    A row has the mean loss since the previous row, the validation PSNR, the learning rate of the step and the speed.

    Args:
        folder: folder of this file. A training that begins at its first step clears what another one has left there.
        start: the step from which the training goes on; rows that a killed training wrote beyond it are dropped.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self.path = folder / "log.csv"
        self._text = ""
        if self.path.is_file():
            self._keep_rows(self.path.read_text(errors="replace"), start)

    def _keep_rows(self, text: str, last: int) -> None:
        """Write the file anew with the rows up to the step ``last``, without those that are damaged."""
        head, *rows = text.splitlines(keepends=True) or [""]
        earlier = []
        for row in rows:
            step = row.partition(",")[0]
            is_whole = row.endswith("\n") and step.isdecimal()
            if is_whole and int(step) <= last:
                earlier.append(row)

        if earlier:
            self._text = "".join([head, *earlier])
        write_text(self._text, self.path)

    def log(self, step: int, **values: float) -> None:
        """Write the file anew with one more row; on a full disk, the rows before it stay."""
        if not self._text:
            self._text = ",".join(["step", *values]) + "\n"
        self._text += ",".join([str(step), *[f"{value:.6g}" for value in values.values()]]) + "\n"
        write_text(self._text, self.path)
