"""``rawaug data check``: identify the dataset and list damaged files."""

from __future__ import annotations

from rawaug.data import check
from rawaug.registry import COMMANDS


@COMMANDS.register("data check")
def run(path: str, *, first: int | None = None) -> None:
    """Identify the dataset, count items, sizes, CFAs and levels, and list damaged files.

    Args:
        path: a folder, a RAW file, or a submission to SIDD.
        first: read at most this many items of each kind.

    Raises:
        ValueError: if a file is damaged.
    """
    report = check(path, first)
    print(report)
    if report.broken:
        raise ValueError(f"{path}: {len(report.broken)} damaged, listed above")
