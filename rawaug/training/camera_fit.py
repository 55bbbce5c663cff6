"""``rawaug.fit``: makes a camera with its noise law from files, folders or pairs.

The noise is measured by photon transfer on the fitted frames, those of each ISO together, and on dark frames if they
are given. It is measured on a pair's captured noisy mosaic if there is one, else on the RAW file itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

from rawaug.camera.own import Camera, as_camera
from rawaug.camera.softness import measure_blur
from rawaug.data import RawFolder, open_pairs
from rawaug.data.frames import Frames, Readable, as_frames, left_out, shared_frame
from rawaug.data.opening import names_dataset
from rawaug.data.pairs import Pair
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.training.noise_fit import measure_camera_noise, plot_camera_noise

_SOFTNESS_FRAMES = 8
"""Softness is measured on so many frames."""

WATCHED_PATCHES = 4
"""This many patches of a held-out frame are scored during the fit."""


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
    camera: str | Path | Camera | None = None,
    **settings: Any,
) -> DictionaryISP:
    """Fit an ISP to your own camera.

    Args:
        source: a RAW file, a folder of them, a list of files and folders, ``kind:path`` of a known dataset, or pairs.
        progress: show progress bars.
        noise: "on" also measures the camera's noise levels, for ``RawAugment(isp, noise="camera")``; "auto" continues
            without them if they cannot be measured; the reason is in ``isp.info["noise_not_measured"]``.
        dark: folder of dark frames to measure the read variance.
        noise_figure: where to draw the measured points and the line.
        camera_jpeg: use the camera's JPEG of the same stem as the sRGB; False always uses LibRaw's rendering.
        held_out: frames to leave out of the fit; their PSNR_r is shown in the progress bar and stored in
            ``isp.info["held_out"]``.
        state: file with the state of the fit, to resume it; removed at the end.
        cfa, black, white: values for the files of ``pairs:PATH`` that do not state them, see
            :class:`rawaug.data.PairFolder`.
        camera: figures of the camera to start from, a :class:`rawaug.Camera` or its YAML file, or a published camera by
            its name. They decide what the colours of the frames leave open.
        settings: settings of :class:`rawaug.isp.fit.FitConfig`.

    The softness of the camera is measured on the frames (:mod:`rawaug.camera.softness`) and stored in
    ``isp.info["blur"]``, in pixels, which :class:`rawaug.RawAugment` then draws.

    Fitted and held-out frames that cannot be read are left out; ``isp.info["unreadable"]`` has a line for each.

    Raises:
        FileNotFoundError, ValueError: if a file is missing, none can be read as a Bayer RAW file, or a held-out frame
            is also fitted.

    Example:
        >>> isp = fit("demo:train", steps=2, curve_steps=2, pixels=512, noise="off", progress=False)
        >>> isp.info["frames"][0]
        'train_00_astronaut'
    """
    if noise not in ("auto", "on", "off"):
        raise ValueError(f"noise must be auto, on or off, got {noise!r}")
    if noise == "off" and dark is not None:
        raise ValueError(f"dark {dark}: has no use with noise: off; leave one of them out")
    start = time.perf_counter()

    stated = {key: value for key, value in (("cfa", cfa), ("black", black), ("white", white)) if value is not None}
    pairs = _open_pairs(source, camera_jpeg, stated)
    frames = Readable(pairs)

    # Held-out frames are decoded once.
    watched: Readable | None = None
    scores: list[dict[str, float]] = []
    if held_out is not None:
        held_out_pairs = _open_pairs(held_out, camera_jpeg, stated if str(held_out).startswith("pairs:") else {})
        shared = shared_frame(held_out_pairs, pairs)
        if shared is not None:
            raise ValueError(f"held-out: {shared} is also fitted; hold out other frames")
        watched = Readable(held_out_pairs.kept())

    def score(isp: DictionaryISP) -> str:
        """Note PSNR_r on a few patches of each held-out frame."""
        assert watched is not None
        blind_scores, as_shot_scores = [], []
        for pair in watched:
            blind_scores.append(psnr_r(isp, pair, False, WATCHED_PATCHES))
            as_shot_scores.append(psnr_r(isp, pair, True, WATCHED_PATCHES))

        blind, as_shot = fmean(blind_scores), fmean(as_shot_scores)
        scores.append({"blind": round(blind, 2), "as_shot": round(as_shot, 2)})
        return f"held out {blind:.2f} dB, {as_shot:.2f} dB with as-shot gains"

    # The noise comes before the fit, so that failures come early.
    law = None
    if noise != "off":
        try:
            law, estimates = measure_camera_noise(frames, dark)
        except ValueError as error:
            if noise == "on":
                raise
            not_measured = str(error)

    figures = None if camera is None else as_camera(camera)
    isp = fit_isp(frames, FitConfig(**settings), progress, state, score if watched is not None else None, figures)
    if figures is not None:
        isp.info["started_from"] = figures.name

    unreadable = left_out(frames, "the fit")
    if watched is not None:
        score(isp)
        isp.info["held_out"] = scores
        unreadable = [*unreadable, *left_out(watched, "held-out frames")]
    if unreadable:
        isp.info["unreadable"] = unreadable

    if law is not None:
        isp.info["noise"] = law.spec()
        if noise_figure is not None:
            plot_camera_noise(law, estimates, noise_figure)
    elif noise == "auto":
        isp.info["noise_not_measured"] = not_measured

    blur = measure_blur((pair.clean.mosaic[0].numpy(), pair.cfa) for pair in islice(iter(frames), _SOFTNESS_FRAMES))
    if blur is not None:
        isp.info["blur"] = round(blur, 2)

    isp.info["rendering"] = describe_rendering(pairs, len(isp.info["frames"]), isp.info["registered"])
    isp.info["seconds"] = round(time.perf_counter() - start, 2)
    return isp


def describe_rendering(pairs: Frames[Pair], frames: int, registered: int) -> str:
    """Name the renderings that were fitted, whose tone curve and colours the ISP undoes.

    Registered pairs are not JPEGs of the camera.
    """
    counts = {pairs.rendering: registered, "JPEG of the camera": frames - registered}

    return ", ".join(f"{name} ({count} of {frames})" for name, count in counts.items() if count)


def _open_pairs(
    source: str | Path | Sequence[str | Path] | Sequence[Pair], camera_jpeg: bool, stated: Mapping[str, Any]
) -> Frames[Pair]:
    """Open files and folders as one folder, a single dataset, or the given pairs; ``stated`` is what files omit."""
    if isinstance(source, (str, Path)):
        source = [source]
    if not hasattr(source, "__getitem__") or not len(source):
        raise ValueError("nothing to fit; give one or more files, folders or pairs")

    if isinstance(source[0], Pair):
        if stated:
            raise ValueError(f"{', '.join(stated)} can only be given for pairs:PATH; each Pair has its own")
        return as_frames(source)  # type: ignore[arg-type]
    if not isinstance(source[0], (str, Path)):
        raise ValueError(f"a fit takes files, folders or Pairs, got {type(source[0]).__name__}; see docs/fit.md")

    for item in source:
        pairs = open_pairs(str(item), split="train", as_clean=False, **stated)
        if not names_dataset(item):  # type: ignore[arg-type]
            continue
        if len(source) > 1:
            raise ValueError(f"{item}: a kind:path dataset cannot be combined with other files; give it alone")
        return pairs

    return RawFolder(map(str, source), camera_jpeg=camera_jpeg)
