"""``rawaug data check``: identify the dataset and list damaged files."""

from __future__ import annotations

from rawaug.data import check
from rawaug.data.pair_folder import PairSettings
from rawaug.registry import COMMANDS


@COMMANDS.register("data check")
def run(path: str, *, first: int | None = None, settings: PairSettings) -> None:
    """Identify the dataset, count items, sizes, CFAs and levels, and list damaged files.

    Args:
        path: a folder, a RAW file, a submission to SIDD, or pairs:PATH.
        first: read at most this many items of each kind.
        settings: of pairs:PATH.

    Raises:
        ValueError: if a file is damaged.
    """
    report = check(path, first, **vars(settings))
    print(report)
    if report.broken:
        raise ValueError(f"{path}: {len(report.broken)} damaged, listed above")
