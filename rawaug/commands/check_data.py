"""``rawaug data check``: identify the dataset and list damaged files."""

from __future__ import annotations

from typing import Any

from rawaug.data import check


def add_arguments(parser: Any) -> None:
    """The command's arguments."""
    parser.add_argument("path", type=str, help="a folder, a RAW file, or a submission to SIDD")
    parser.add_argument("--first", type=int | None, default=None, help="read at most this many items of each kind")


def run(arguments: Any) -> None:
    """Print the report.

    Raises:
        ValueError: if a file is damaged.
    """
    report = check(arguments.path, arguments.first)
    print(report)
    if report.broken:
        raise ValueError(f"{arguments.path}: {len(report.broken)} damaged, listed above")
