"""``rawaug data check``: identify the dataset and list damaged files."""

from __future__ import annotations

from typing import Annotated

from rawaug.commands import OPTIONS
from rawaug.data import check
from rawaug.data.pair_folder import PairSettings


def run(path: str, /, *, first: int | None = None, settings: Annotated[PairSettings, OPTIONS] | None = None) -> None:
    """Identify a dataset, count its files and list damaged ones.

    Args:
        path: a folder, a RAW file, or kind:PATH, such as pairs:PATH or real:test.
        first: read at most this many items of each kind.
        settings: CFA, levels and file names of pairs:PATH.
    """
    report = check(path, first, **vars(settings or PairSettings()))
    print(report)
    counts = []
    if report.broken:
        counts.append(f"{len(report.broken)} damaged")
    if report.unfit:
        counts.append(f"{len(report.unfit)} not usable")
    if counts:
        raise ValueError(f"{path}: {', '.join(counts)}; they are listed above")
