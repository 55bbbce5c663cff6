"""One path for everything that is denoised: RAW frames, files and folders, and pictures."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from rawaug.denoising.folder import Files, denoise_file
from rawaug.denoising.levels import Noise
from rawaug.denoising.pictures import LINEAR, PictureFiles
from rawaug.denoising.raw import Greens, RawFiles, Strength
from rawaug.files import files_below, require_output
from rawaug.io import RawFrame
from rawaug.io.content import ALL_PICTURE_EXTENSIONS, RAW_EXTENSIONS, identify_content, picture_extensions


def denoise(
    source: str | Path | RawFrame,
    out: str | Path | None = None,
    *,
    denoiser: Any = None,
    noise: Noise = "auto",
    strength: Strength = 1.0,
    linear: bool = False,
    self_ensemble: bool = False,
    greens: Greens = "auto",
    defects: str | Path = "mend",
    guard: bool | None = None,
    device: str = "auto",
    preview: str | Path | None = None,
    overwrite: bool = False,
) -> Any:
    """Denoise a RAW file, a frame or a picture, as ``rawaug denoise`` does.

    Args:
        source: a RAW file of any kind that :func:`rawaug.io.read_raw` reads, monochrome ones too, a frame, or a
            developed picture.
        out: a DNG or a picture to write as well; None writes none.
        denoiser: whatever :meth:`rawaug.RawDenoiser.of` takes: a shipped name, a file, a filter by its name, a network,
            a function, ...; by default the shipped one for the frame's pattern, or for pictures.
        noise: where the noise levels of RAW come from, see :data:`rawaug.denoising.levels.Noise`.
        strength: 1 removes the noise, 0.7 leaves 30% of it, 0 changes nothing, ``"auto"`` leaves grain of 1% of mid
            grey, which is most of weak noise and little of strong; for pictures, a factor on the estimated level of
            the noise.
        linear: also demosaic RAW, to linear camera RGB.
        self_ensemble: average eight views, at eight times the cost.
        greens: ``"keep"`` leaves the two greens of a Bayer sensor that differ as they are.
        defects: ``"mend"`` leaves single hot and dead pixels to the denoiser, which replaces them; ``"keep"`` keeps
            them, as stars are; or the file of a map of defects, whose sites are replaced while others are kept, see
            :func:`rawaug.find_defects`.
        guard: blend the result of a Bayer mosaic with its input, and with non-local means, where it is estimated to be
            worse than that; None guards networks.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        preview: a .jpg or .png of the result of RAW to write as well, developed by LibRaw.
        overwrite: replace ``out`` and ``preview`` if they exist.

    Returns:
        The frame with a denoised mosaic, float32 ``(1, H, W)``, black 0 and white 1, whose ``noise_profile`` says what
        noise is left; with ``linear``, camera RGB ``(3, H, W)``; of a picture, sRGB ``(3, H, W)`` in [0, 1].

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the noise is unknown, there is no such denoiser, or a setting does not fit the source.

    Example:
        >>> frame = rawaug.denoise("in.dng", "out.dng", denoiser="rawaug-base")  # doctest: +SKIP
        >>> srgb = rawaug.denoise("in.jpg")  # doctest: +SKIP
    """
    for_raw = {"linear": linear, "noise": noise, "greens": greens, "defects": defects, "guard": guard}
    files = files_for(source, denoiser, strength, self_ensemble, device, **for_raw)
    if not isinstance(source, RawFrame):
        image, _ = denoise_file(source, out, files, preview=preview, overwrite=overwrite)
        return image

    if out is not None:
        out = require_output(out, overwrite, files.formats, advice=files.format_advice)
    image, _ = files.denoise(source, out)
    return image


def files_for(
    source: str | Path | RawFrame,
    denoiser: Any = None,
    strength: Strength = 1.0,
    self_ensemble: bool = False,
    device: str = "auto",
    **for_raw: Any,
) -> Files[Any]:
    """Say how the files of a source are denoised: by its content; a folder is of pictures if it has no RAW file.

    Args:
        source: a file, a folder or a frame.
        denoiser: None for the shipped one.
        strength, self_ensemble, device: as in :func:`denoise`, for the denoiser.
        for_raw: ``linear``, ``noise``, ``greens``, ``defects`` and ``guard`` of :func:`denoise`; a picture takes none.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a file of no kind, or a setting does not fit it.
    """
    if _is_raw(source):
        return RawFiles(denoiser, strength, self_ensemble, device, **for_raw)

    defaults = inspect.signature(RawFiles).parameters
    stated = [argument for argument, value in for_raw.items() if value != defaults[argument].default]
    if stated:
        raise ValueError(f"{source}: is a developed picture; {stated[0]}= is for RAW")
    if isinstance(strength, str):
        raise ValueError(f"{source}: is a developed picture; strength= is a number for it, by default 1")
    return PictureFiles(denoiser, strength, self_ensemble, device)


def is_mixed(folder: Path) -> bool:
    """Tell whether a folder holds both RAW files and developed pictures that are not the camera's own of them."""
    developed = set(picture_extensions()).difference(LINEAR)
    raw, pictures = set(), set()
    for file in files_below(folder):
        extension = file.suffix.lower()
        if extension in RAW_EXTENSIONS:
            raw.add(file.with_suffix(""))
        elif extension in developed:
            pictures.add(file.with_suffix(""))
    return bool(raw) and bool(pictures - raw)


def _is_raw(source: str | Path | RawFrame) -> bool:
    if isinstance(source, RawFrame):
        return True

    path = Path(source)
    if path.is_dir():
        extensions = {file.suffix.lower() for file in files_below(path)}
        has_pictures = not extensions.isdisjoint(ALL_PICTURE_EXTENSIONS)
        return not has_pictures or not extensions.isdisjoint(RAW_EXTENSIONS)

    kind = identify_content(path).kind
    if kind not in ("raw", "picture"):
        raise ValueError(f"{path}: is neither camera RAW nor a picture of a known format; check that it is complete")
    return kind == "raw"
