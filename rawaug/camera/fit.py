"""``rawaug.fit``: files, folders or pairs in, a camera with its noise law out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

from rawaug.camera.noise import CameraNoise, measure_camera_noise
from rawaug.camera.psnr_r import psnr_r
from rawaug.data import RawFolder, open_pairs
from rawaug.data.folders import Kept, Readable, left_out
from rawaug.data.pairs import Pair, shared_frame
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP

WATCHED_PATCHES = 4
"""Of each held-out frame, scored while the fit goes on."""


def fit(
    source: str | Path | Sequence[str | Path] | Sequence[Pair],
    progress: bool = True,
    noise: Literal["auto", "on", "off"] = "auto",
    dark: str | Path | None = None,
    noise_figure: str | Path | None = None,
    camera_jpeg: bool = True,
    held_out: str | Path | Sequence[Pair] | None = None,
    state: str | Path | None = None,
    cfa: str | None = None,
    black: float | Sequence[float] | None = None,
    white: float | None = None,
    **settings: Any,
) -> DictionaryISP:
    """Fit an ISP to your own camera.

    Args:
        source: a RAW file, a folder of them, a list of files and folders, ``kind:path`` of a known dataset, or pairs.
        progress: show progress bars.
        noise: "on" also measures the camera's noise levels, for ``RawAugment(isp, noise="camera")``; "auto"
            continues without them where they cannot be measured; the reason is in ``isp.info["noise_not_measured"]``.
        dark: folder of dark frames to measure the read variance.
        noise_figure: where to draw the measured points and the line.
        camera_jpeg: use the camera's JPEG of the same stem as the sRGB; False always uses LibRaw's rendering.
        held_out: frames to leave out of the fit; their PSNR_r is shown in the progress bar and stored in
            ``isp.info["held_out"]``.
        state: file with the state of the fit, to resume it; removed at the end.
        cfa, black, white: of the files of ``pairs:PATH`` that do not state them, see :class:`rawaug.data.PairFolder`.
        settings: of :class:`rawaug.isp.fit.FitConfig`.

    Frames that cannot be read, of those fitted and those held out, are left out; ``isp.info["unreadable"]`` has a line
    for each.

    Raises:
        FileNotFoundError, ValueError: if a file is missing, none can be read as a Bayer RAW file, or a held-out frame
            is also fitted.

    Example:
        >>> isp = fit("demo:train", steps=2, pixels=512, progress=False)
        >>> isp.info["frames"][0]
        'train_00_astronaut'
    """
    if noise not in ("auto", "on", "off"):
        raise ValueError(f"noise must be auto, on or off, got {noise!r}")
    start = time.perf_counter()
    mosaics = {key: value for key, value in (("cfa", cfa), ("black", black), ("white", white)) if value is not None}
    pairs = _pairs(source, camera_jpeg, mosaics)
    watch = None
    if held_out is not None:
        others = _pairs(held_out, camera_jpeg, mosaics if str(held_out).startswith("pairs:") else {})
        if (seen := shared_frame(others, pairs)) is not None:
            raise ValueError(f"held-out: {seen} is also fitted; hold out other frames")
        watch = _Watch(others)
    frames = Readable(pairs)
    estimate = _measured_noise(frames, noise, dark)  # before the fit: what fails here fails early
    isp = fit_isp(frames, FitConfig(**settings), progress, state, watch)
    if watch is not None:
        watch(isp)
        isp.info["held_out"] = watch.scores
    if lines := [*left_out(frames, "the fit"), *left_out(watch.pairs if watch else Readable([]), "held-out frames")]:
        isp.info["unreadable"] = lines
    if isinstance(estimate, str):
        isp.info["noise_not_measured"] = estimate
    elif estimate is not None:
        isp.info["noise"] = estimate.law.spec()
        if noise_figure is not None:
            estimate.plot(noise_figure)
    isp.info["rendering"] = rendering_of(pairs, len(isp.info["frames"]), isp.info["registered"])
    isp.info["seconds"] = round(time.perf_counter() - start, 2)
    return isp


def _measured_noise(pairs: Sequence[Pair], noise: str, dark: str | Path | None) -> CameraNoise | str | None:
    """The levels, or why they could not be measured."""
    if noise == "off":
        return None
    try:
        return measure_camera_noise(pairs, dark)
    except ValueError as error:
        if noise == "on":
            raise
        return str(error)


def rendering_of(pairs: Sequence[Pair], frames: int, registered: int) -> str:
    """What rendering the fit was to, whose tone curve and colours the ISP undoes; registered pairs are no JPEGs."""
    own = "LibRaw" if isinstance(pairs, RawFolder) else "sRGB of the pairs"
    counts = {own: registered, "JPEG of the camera": frames - registered}
    return ", ".join(f"{name} ({count} of {frames})" for name, count in counts.items() if count)


class _Watch:
    """PSNR_r of held-out frames, which are decoded once, on a few patches of each."""

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = Readable(Kept(pairs))
        self.scores: list[dict[str, float]] = []

    def __call__(self, isp: DictionaryISP) -> str:
        scores = [[psnr_r(isp, pair, known, WATCHED_PATCHES) for known in (False, True)] for pair in self.pairs]
        blind, given = (fmean(of_frames) for of_frames in zip(*scores, strict=True))
        self.scores.append({"blind": round(blind, 2), "as_shot": round(given, 2)})
        return f"held out {blind:.2f} dB, {given:.2f} dB with as-shot gains"


def _pairs(
    source: str | Path | Sequence[str | Path] | Sequence[Pair], camera_jpeg: bool, mosaics: Mapping[str, Any]
) -> Sequence[Pair]:
    if isinstance(source, (str, Path)):
        source = [source]
    if not hasattr(source, "__getitem__") or not len(source):
        raise ValueError("nothing to fit; give one or more files, folders or pairs")
    if isinstance(source[0], Pair):
        if mosaics:
            raise ValueError(f"{', '.join(mosaics)} can only be given for pairs:PATH; each Pair has its own")
        return source  # type: ignore[return-value]
    if not isinstance(source[0], (str, Path)):
        raise ValueError(f"a fit takes files, folders or Pairs, got {type(source[0]).__name__}; see docs/fit.md")
    opened = [open_pairs(str(item), split="train", as_clean=False, **mosaics) for item in source]
    if len(opened) == 1 and not isinstance(opened[0], RawFolder):
        return opened[0]
    files: list[Path] = []
    for item, pairs in zip(source, opened, strict=True):
        if not isinstance(pairs, RawFolder):
            raise ValueError(f"{item}: a kind:path dataset cannot be combined with other files; give it alone")
        files += pairs.files
    return RawFolder(files, camera_jpeg=camera_jpeg)
