"""``rawaug.fit``: files, folders or pairs in, a camera out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from rawaug.data import RawFolder, open_pairs
from rawaug.data.pairs import Pair
from rawaug.experiment.camera_noise import as_info, measure_camera_noise
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.noise import plot_noise


def fit(
    source: str | Path | Sequence[str | Path] | Sequence[Pair],
    progress: bool = True,
    noise: Literal["auto", "on", "off"] = "auto",
    dark: str | Path | None = None,
    noise_figure: str | Path | None = None,
    **settings: Any,
) -> DictionaryISP:
    """Fit a camera of one's own.

    Args:
        source: a RAW file, a folder of them, a list of files, ``kind:path`` of a known dataset, or pairs.
        progress: show progress bars.
        noise: "on" also measures the camera's noise levels, for ``RawAugment(isp, noise="camera")``; "auto" goes on
            without where the frames do not show them, and says why in ``isp.info["noise_not_measured"]``.
        dark: folder of dark frames, which then tell the read variance.
        noise_figure: where to draw the measured points and the line.
        settings: of :class:`rawaug.isp.fit.FitConfig`.

    Raises:
        FileNotFoundError, ValueError: if a file is missing or not a Bayer RAW file.

    Example:
        >>> isp = fit("demo:train", steps=2, pixels=512, progress=False)
        >>> isp.info["frames"][0]
        'train_00_astronaut'
    """
    pairs = _pairs(source)
    start = time.perf_counter()
    isp = fit_isp(pairs, FitConfig(**settings), progress)
    if noise != "off":
        try:
            estimate = measure_camera_noise(pairs, dark)
        except ValueError as error:
            if noise == "on":
                raise
            isp.info["noise_not_measured"] = str(error)
        else:
            isp.info["noise"] = as_info(estimate)
            if noise_figure is not None:
                plot_noise(estimate, noise_figure, title=", ".join(isp.info["frames"][:4]))
    isp.info["seconds"] = round(time.perf_counter() - start, 2)
    return isp


def _pairs(source: str | Path | Sequence[str | Path] | Sequence[Pair]) -> Sequence[Pair]:
    if isinstance(source, (str, Path)):
        return open_pairs(str(source), split="train")
    if len(source) and isinstance(source[0], Pair):
        return list(source)  # type: ignore[arg-type]
    return RawFolder(source)  # type: ignore[arg-type]
