"""Developed pictures in files, which are denoised to pictures of the same kind."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from rawaug.denoising.base import Noisy
from rawaug.denoising.files import Files
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.errors import escape
from rawaug.files import files_below
from rawaug.io import RawFrame
from rawaug.io.content import RAW_EXTENSIONS, Listing, picture_extensions
from rawaug.io.isolated import isolated
from rawaug.io.stored import PICTURE_FORMATS, StoredPicture, read_stored, write_stored

LINEAR = (".exr",)
"""The extensions of pictures of linear light."""
_SUBSTITUTE = ".png"
"""The format of results of pictures whose own format is read but not written; it loses nothing."""


@dataclass(frozen=True)
class DenoisedPicture:
    """What was done to a picture; ``deviation`` is the removed noise's, in units of 1/255."""

    source: Path
    out: Path | None
    deviation: float
    seconds: float

    def __str__(self) -> str:
        return f"{escape(self.out)}: noise of {self.deviation:.1f} in 255 removed, {self.seconds:.1f} s"


class PictureFiles(Files[DenoisedPicture]):
    """Developed pictures, which are denoised to pictures with their EXIF, ICC profile and orientation.

    Args:
        denoiser: whatever :meth:`rawaug.denoising.pictures.PictureDenoiser.of` takes; None for the shipped one.
        strength: a factor on the estimated level of the noise.
        self_ensemble: whether eight views are averaged.
        device: where a network runs: auto, cpu, cuda, ...

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if there is no such denoiser, or a setting does not fit it.
    """

    what = "picture"
    formats = PICTURE_FORMATS
    format_advice = f"the source is a developed picture; its output is one of {', '.join(PICTURE_FORMATS)}"
    others = "not a picture that is known"

    def __init__(
        self, denoiser: Any = None, *, strength: float = 1.0, self_ensemble: bool = False, device: str = "auto"
    ) -> None:
        changes: dict[str, Any] = {}
        if strength != 1.0:
            changes["strength"] = strength
        if self_ensemble:
            changes["views"] = 8

        if denoiser is None:
            denoiser = PictureDenoiser.default
        if not isinstance(denoiser, PictureDenoiser) or changes or device != "auto":
            denoiser = PictureDenoiser.of(denoiser, device, "auto", **changes)
        self.denoiser: PictureDenoiser = denoiser

    def extensions(self) -> tuple[str, ...]:
        return tuple(extension for extension in picture_extensions() if extension not in LINEAR)

    def _select(self, folder: Path, listing: Listing) -> None:
        """Leave out a picture that has the stem of a RAW file: it is the camera's own rendering of it."""
        raw = {file.with_suffix("") for file in files_below(folder) if file.suffix.lower() in RAW_EXTENSIONS}
        beside = [file for file in listing.files if file.with_suffix("") in raw]
        for file in beside:
            advice = "pictures of the camera's own, beside the RAW files that they show; name one to denoise it"
            listing.leave_out("rendering", advice, file.suffix.lower())
            listing.files.remove(file)

        if "picture" in listing.left_out:
            listing.left_out["picture"].advice = "linear light; save it as a developed picture"

    def target(self, file: Path) -> Path:
        """Keep the name of the file, with ``.png`` appended if its format is read but not written."""
        if file.suffix.lower() in PICTURE_FORMATS:
            return file
        return file.with_name(file.name + _SUBSTITUTE)

    def remarks(self, files: Sequence[Path]) -> list[str]:
        counts = Counter(file.suffix.lower() for file in files if self.target(file) != file)
        if not counts:
            return []

        listed = ", ".join(f"{extension} {count}" for extension, count in counts.most_common())
        plural = "s have" if counts.total() > 1 else " has"
        return [f"{counts.total()} result{plural} another format than the source, {_SUBSTITUTE}: {listed}"]

    def require_preview(self, preview: Path) -> None:
        raise ValueError(f"preview={preview}: is for RAW files")

    def denoise(
        self, source: Path | RawFrame, out: Path | None = None, preview: Path | None = None, isolate: bool = True
    ) -> tuple[Tensor, DenoisedPicture]:
        """Denoise a picture; see :meth:`rawaug.denoising.files.Files.denoise`.

        Returns:
            sRGB ``(3, H, W)`` in [0, 1], upright or turned as the file stores it; and what was done.
        """
        if isinstance(source, RawFrame):
            raise ValueError(f"{source.name}: is a RAW frame, not a developed picture")
        start = time.perf_counter()
        picture: StoredPicture = isolated(read_stored, source)
        srgb = picture.srgb
        height, width = srgb.shape[-2:]
        if min(height, width) < 2:
            raise ValueError(f"{source}: is {width} x {height} pixels; at least 2 x 2 needed")

        denoised = self.denoiser(Noisy(srgb[None]))[0]
        deviation = 255.0 * (denoised - srgb).square().mean().sqrt().item()

        if out is not None:
            write_stored(out, denoised, picture)
        return denoised, DenoisedPicture(source, out, deviation, time.perf_counter() - start)
