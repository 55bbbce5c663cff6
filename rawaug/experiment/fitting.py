"""``rawaug.fit``: files, folders or pairs in, a camera out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rawaug.data import RawFolder, open_pairs
from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP


def fit(
    source: str | Path | Sequence[str | Path] | Sequence[Pair], progress: bool = True, **settings: Any
) -> DictionaryISP:
    """Fit a camera of one's own.

    Args:
        source: a RAW file, a folder of them, a list of files, ``kind:path`` of a known dataset, or pairs.
        progress: show progress bars.
        settings: of :class:`rawaug.isp.fit.FitConfig`.

    Raises:
        FileNotFoundError, ValueError: if a file is missing or not a Bayer RAW file.

    Example:
        >>> isp = fit("demo:train", steps=2, pixels=512, progress=False)
        >>> isp.info["frames"][0]
        'train_00_astronaut'
    """
    pairs: Sequence[Pair]
    if isinstance(source, (str, Path)):
        pairs = open_pairs(str(source), split="train")
    elif len(source) and isinstance(source[0], Pair):
        pairs = list(source)  # type: ignore[arg-type]
    else:
        pairs = RawFolder(source)  # type: ignore[arg-type]
    start = time.perf_counter()
    isp = fit_isp(pairs, FitConfig(**settings), progress)
    isp.info["seconds"] = round(time.perf_counter() - start, 2)
    return isp
