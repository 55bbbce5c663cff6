r"""RAW files and frames, which are denoised to DNGs and frames.

    y' = y + s (f(y, shot_var max(y, 0) + read_var) - y)

This is done on the mosaic as the sensor gave it, before any gain map. The result has the source's levels, colour, lens
corrections, orientation and EXIF; it differs by noise, and by the two greens of a Bayer sensor, which are made to agree
where smooth places show that they clearly differ (:mod:`rawaug.bayer.greens`). Its noise profile is removed along with
the noise, so that a RAW developer does not smooth once more. With a strength s below 1, (1 - s)^2 of the noise's
variance is left, and the noise profile says so. A network that also demosaics gives camera RGB.

With ``grain``, s falls with the noise, so that grain of one deviation g is left in every frame,

    s = max(0, 1 - g / d), d = sqrt(shot_var m + read_var) / m

where d is the noise at mid grey m in units of m. At weak noise there is little to remove, and texture as fine as the
noise, which a network turns into strokes, is kept along with the grain.

A monochrome frame is denoised as the mosaic of a grey scene, which it is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from denoisers.files import JOINT
from rawaug import bayer
from rawaug.bayer import CFA, GreenDifference
from rawaug.denoising.convolutions import choose_network
from rawaug.denoising.defects import find_lone_sites, mend_sites, read_defects
from rawaug.denoising.denoiser import Levels, Noisy, RawDenoiser, open_denoiser
from rawaug.denoising.folder import Files
from rawaug.denoising.guard import SECOND, guard_result
from rawaug.denoising.levels import Noise, find_levels, load_noise, noise_as_json
from rawaug.errors import count_of, escape
from rawaug.files import sha256
from rawaug.io import RawFrame, read_raw, write_dng, write_picture
from rawaug.io.cells import MONOCHROME
from rawaug.io.content import RAW_EXTENSIONS, Listing, list_files
from rawaug.io.dng import LINEAR_WHITE, cell_of_planes
from rawaug.io.isolated import isolated
from rawaug.io.raw import develop
from rawaug.kernels.runtime import find_device

MID_GREY = 0.18
"""The signal whose noise is stated for photographers, on the scale black 0, white 1."""

GRAIN = 0.01
"""What ``grain`` leaves of the noise at mid grey, in units of mid grey: half a code of 8 bits, developed."""

_SOURCES = {"profile": "by its tag", "estimate": "estimated", "given": "as given", "camera": "by its camera's law"}
"""Where noise levels come from, in the words of a line for photographers; a camera or other files are named."""

OTHER_PATTERNS = "rawaug-xtrans"
"""The denoiser of X-Trans and Quad-Bayer frames if none is named."""

Strength = float | Literal["auto"]
"""The share of the noise that is removed, or ``"auto"``, which leaves the same grain in every frame."""

Greens = Literal["auto", "keep"]
"""Whether greens that clearly differ are made to agree, or kept as they are."""


@dataclass(frozen=True)
class Denoised:
    """What was done to a RAW file.

    Attributes:
        source, out: the files; None for a frame in memory, or if nothing was written.
        shot_var, read_var: the noise levels that the denoiser was given; 0 if it needs none.
        noise_source: where the levels come from.
        below_zero: the share of sites whose result was below the digital number 0.
        seconds: the time for reading, denoising and writing.
        camera, iso: the source's camera and ISO.
        greens: by how much the two greens of a Bayer sensor differ; None if that cannot be measured.
        balanced: whether this difference was taken out.
        mended: the number of sites of a map of defects that were replaced.
        kept: the number of sites that look like defects and were left as they are.
        blended: the mean share of the result in its blend with the input; 1 without the guard, or where it found none
            of the frame harmed.
        strength: the share of the noise that was removed.
    """

    source: Path | None
    out: Path | None
    shot_var: float
    read_var: float
    noise_source: str
    below_zero: float
    seconds: float
    camera: str
    iso: float | None
    greens: GreenDifference | None = None
    balanced: bool = False
    mended: int = 0
    kept: int = 0
    blended: float = 1.0
    strength: float = 1.0

    def __str__(self) -> str:
        """A line for photographers: the deviation of the noise in per cent of mid grey, and where it is known from."""
        removed = "removed"
        if self.strength < 1.0:
            removed = f"{self.strength:.0%} of it removed"

        deviation = 100 * _noise_at_mid_grey(self.shot_var, self.read_var)
        source, *remarks = self.noise_source.split("; ")
        is_uncertain = "uncertain" in source
        source = source.partition(",")[0]
        noise = f"noise of {deviation:.1f} % of mid grey, {_SOURCES.get(source, f'by {source}')}, {removed}"
        if not deviation:
            noise = f"noise {removed}"

        line = f"{escape(self.out)}: {noise}"
        if self.balanced:
            line += ", greens balanced"
        line += self._defects()
        line += f", {self.seconds:.1f} s"
        if is_uncertain:
            line += "; the estimate is uncertain"
        for remark in remarks:
            if not remark.startswith("read_var"):
                line += f"; {remark}"
        return line + self._losses()

    @property
    def details(self) -> str:
        """The same in numbers: noise levels, how they were found, and what was corrected."""
        levels = f"shot_var {self.shot_var:.3g}, read_var {self.read_var:.3g} ({self.noise_source})"
        line = f"{escape(self.out)}: {levels}"
        if self.greens is not None and self.balanced:
            line += f", greens differed by {self.greens.share:.2%} +- {self.greens.error:.2%}, balanced"
        return f"{line}{self._defects()}, {self.seconds:.1f} s{self._losses()}"

    def _defects(self) -> str:
        words = ""
        if self.mended:
            words += f", {count_of(self.mended, 'defect')} of the map mended"
        if self.kept:
            words += f", {count_of(self.kept, 'lone site')} kept"
        return words

    def _losses(self) -> str:
        line = ""
        if self.blended < 0.995:
            line += f"; blended with its input and {SECOND}, the denoiser has {self.blended:.0%}"
        if self.below_zero:
            line += f"; {self.below_zero:.2%} below digital number 0, written as 0"
        return line


class RawFiles(Files[Denoised]):
    """RAW files and frames, with the denoiser of their pattern and the noise levels of each.

    Args:
        denoiser: whatever :meth:`rawaug.RawDenoiser.of` takes; None stands for the shipped one of each frame's pattern,
            or for the one that demosaics.
        strength, self_ensemble, device: how strongly it denoises, whether it averages eight views, and where it runs.
        linear, noise, greens, defects, guard: as in :func:`rawaug.denoise`.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if there is no such denoiser, or a setting does not fit it.

    Example:
        >>> denoise_file("in.dng", "out.dng", RawFiles("rawaug-base", noise="estimate"))  # doctest: +SKIP
    """

    what = "RAW"
    formats = (".dng",)
    format_advice = "the output is a DNG; give a name ending in .dng"

    def __init__(
        self,
        denoiser: Any = None,
        strength: Strength = 1.0,
        self_ensemble: bool = False,
        device: str = "auto",
        *,
        linear: bool = False,
        noise: Noise = "auto",
        greens: Greens = "auto",
        defects: str | Path = "mend",
        guard: bool | None = None,
    ) -> None:
        grain = strength == "auto"
        if isinstance(strength, str):
            if not grain:
                raise ValueError(f"strength: {strength!r} is unknown; use a number from 0 to 1, or auto")
            strength = 1.0
        if greens not in get_args(Greens):
            raise ValueError(f"greens: {greens!r} is unknown; use one of {', '.join(get_args(Greens))}")

        self.by_pattern = denoiser is None and not linear
        if denoiser is None:
            denoiser = JOINT if linear else choose_network(find_device(device))
        denoiser = open_denoiser(RawDenoiser, denoiser, strength, self_ensemble, device)
        if linear and not denoiser.demosaics:
            raise ValueError(f"{denoiser.name}: denoises the mosaic; linear=True demosaics, too, use {JOINT}")
        if denoiser.demosaics and not linear:
            raise ValueError(f"{denoiser.name}: demosaics too, to a linear DNG; add linear=True")
        if denoiser.demosaics and guard:
            raise ValueError(f"{denoiser.name}: demosaics, too; guard compares mosaics")
        if denoiser.demosaics and defects != "mend":
            raise ValueError(f"{denoiser.name}: demosaics, too; defects is for mosaics")
        if denoiser.demosaics and grain:
            raise ValueError(f"{denoiser.name}: takes no strength=; the noisy frame has no full colour to mix in")
        if guard is None:
            guard = denoiser.reads_levels and not denoiser.demosaics and "classical" not in denoiser.settings

        self.denoiser: RawDenoiser = denoiser
        self.noise = load_noise(noise, denoiser)
        self.greens = greens
        self.defects = defects
        self.sites: Tensor | None = None
        if defects not in ("mend", "keep"):
            self.sites = read_defects(defects)
        self.guard = guard
        self.grain = grain

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the results depend on, as JSON."""
        settings = dict(self.denoiser.settings)
        if settings:
            settings["self_ensemble"] = self.denoiser.views > 1
        settings["noise"] = noise_as_json(self.noise)

        if self.greens != "auto":
            settings["greens"] = self.greens
        if self.sites is not None:
            settings["defects_sha256"] = sha256(Path(self.defects))
        elif self.defects != "mend":
            settings["defects"] = self.defects
        if not self.denoiser.demosaics:
            settings["guard"] = self.guard
        if self.grain:
            settings["strength"] = "auto"
        elif self.denoiser.strength != 1.0:
            settings["strength"] = self.denoiser.strength
        return settings

    @cached_property
    def _of_other_patterns(self) -> RawDenoiser:
        like = self.denoiser
        return RawDenoiser.of(OTHER_PATTERNS, like.device, "auto", views=like.views, strength=like.strength)

    def denoiser_for(self, cfa: str) -> RawDenoiser:
        """The denoiser of frames of a pattern: the one that was named, or the shipped one of this pattern."""
        if self.by_pattern and cfa not in (*CFA.__members__, MONOCHROME):
            return self._of_other_patterns
        return self.denoiser

    def denoise(
        self,
        source: Path | RawFrame,
        out: Path | None = None,
        preview: Path | None = None,
        isolate: bool = False,
    ) -> tuple[RawFrame | Tensor, Denoised]:
        """Denoise a RAW file or a frame; see :meth:`rawaug.denoising.folder.Files.denoise`.

        Returns:
            The frame with the denoised mosaic ``(1, H, W)`` and the noise that is left, or linear camera RGB
            ``(3, H, W)``; and what was done.
        """
        start = time.perf_counter()
        if isinstance(source, RawFrame):
            file, frame = None, source
        else:
            file = source
            frame = isolated(read_raw, file, True) if isolate else read_raw(file, monochrome=True)

        frame, rgb, done = self.denoise_frame(frame)

        if out is not None:
            write_dng(out, frame, file, rgb=rgb)
        seconds = time.perf_counter() - start
        if out is not None and preview is not None:
            self.write_preview(out, preview)
        return (frame if rgb is None else rgb), replace(done, source=file, out=out, seconds=seconds)

    def denoise_frame(self, frame: RawFrame) -> tuple[RawFrame, Tensor | None, Denoised]:
        """Denoise a frame.

        Returns:
            The frame with the denoised mosaic ``(1, H, W)`` and the noise that is left; linear camera RGB ``(3, H, W)``
            where the denoiser demosaics, and the frame is as it was; and what was done.
        """
        # Greens that agree, and the sites of a map mended; a monochrome frame is the mosaic of a grey scene.
        pattern = frame.cfa
        denoiser = self.denoiser_for(pattern)
        unequal, difference = frame, None
        if denoiser.strength > 0:
            frame, difference = equalise_greens(frame, self.greens)
        balanced = frame is not unequal
        if pattern == MONOCHROME:
            if denoiser.demosaics:
                raise ValueError(f"{frame.name}: is monochrome; there is nothing to demosaic, omit linear=True")
            frame = replace(frame, cfa=CFA.RGGB)
        if self.sites is not None:
            frame = mend_sites(frame, self.sites)

        # The levels of the noise, and how much of it is removed.
        levels, noise_source = None, "not needed"
        if denoiser.reads_levels or self.guard or self.grain or self.defects != "mend":
            shot_var, read_var, noise_source = find_levels(frame, self.noise)
            levels = shot_var, read_var
        if self.grain and levels is not None:
            strength = 1.0 - GRAIN / max(_noise_at_mid_grey(*levels), GRAIN)
            denoiser = replace(denoiser, strength=strength)

        # The result: full colour, or a mosaic that is no worse than its input, with single sites as they were.
        noisy = Noisy.of(bayer.pack_if_bayer(frame.mosaic[None], frame.cfa), levels, frame.cfa)
        denoised = denoiser(noisy).clamp(max=1.0)
        blended, kept = 1.0, 0
        if self.guard and denoiser.strength > 0 and levels is not None and frame.cfa in CFA.__members__:
            denoised, blended = guard_result(denoiser, noisy, denoised, denoiser.strength)
        image = bayer.unpack_if_packed(denoised, frame.cfa)[0].clamp(max=1.0)
        if self.defects != "mend" and levels is not None:
            lone = find_lone_sites(frame, levels)
            image = torch.where(lone, frame.mosaic.clamp(max=1.0), image)
            kept = int(lone.sum())

        # Linear RGB, or digital numbers and the noise that is left.
        frame = replace(frame, cfa=pattern)
        rgb = None
        if denoiser.demosaics:
            rgb = image
            below_zero = (rgb < -0.5 / LINEAR_WHITE).float().mean().item()
        else:
            below_zero = clip_below_zero(image, frame)
            profile = remaining_noise(levels or frame.noise_profile, denoiser.strength)
            frame = replace(frame, mosaic=image, noise_profile=profile)

        shot_var, read_var = levels or (0.0, 0.0)
        done = Denoised(
            source=None,
            out=None,
            shot_var=shot_var,
            read_var=read_var,
            noise_source=noise_source,
            below_zero=below_zero,
            seconds=0.0,
            camera=frame.camera,
            iso=frame.iso,
            greens=difference,
            balanced=balanced,
            mended=0 if self.sites is None else len(self.sites),
            kept=kept,
            blended=blended,
            strength=denoiser.strength,
        )
        return frame, rgb, done

    # -- files of a folder ---------------------------------------------------------------------------------------------

    def listing(self, folder: Path) -> Listing:
        """List the RAW files."""
        listing = list_files(folder, RAW_EXTENSIONS, "neither RAW nor a picture that is known")
        listing.advice["RAW file"] = "there is no decoder for these kinds of RAW"
        return self.require_files(folder, listing, RAW_EXTENSIONS)

    def target(self, file: Path) -> Path:
        return file.with_suffix(".dng")

    def require_preview(self, preview: Path) -> None:
        if self.denoiser.demosaics:
            advice = "open the linear DNG in a RAW developer"
            raise ValueError(f"preview={preview}: linear=True does not support it; {advice}")

    def write_preview(self, result: Path, preview: Path) -> None:
        upright = read_raw(result, monochrome=True).upright_view
        write_picture(preview, bayer.turn(develop(result), upright))

    def informed_by(self, results: Sequence[Denoised]) -> RawFiles | None:
        if self.noise != "auto":
            return None

        by_shot: dict[tuple[str, float | None], list[Denoised]] = {}
        for done in results:
            if done.iso is not None:
                by_shot.setdefault((done.camera, done.iso), []).append(done)

        levels = {}
        for shot, files in by_shot.items():
            shot_var = fmean(done.shot_var for done in files)
            read_var = fmean(done.read_var for done in files)
            levels[shot] = shot_var, read_var

        informed = copy(self)
        informed.noise = levels
        return informed


def _noise_at_mid_grey(shot_var: float, read_var: float) -> float:
    return math.sqrt(shot_var * MID_GREY + read_var) / MID_GREY


def remaining_noise(levels: Levels | None, strength: float) -> Levels | None:
    """Compute the levels of the noise that is left; None if none is, or its levels are unknown."""
    share = (1.0 - strength) ** 2
    if levels is None or share == 0.0:
        return None
    shot_var, read_var = levels
    return share * shot_var, share * read_var


def equalise_greens(frame: RawFrame, greens: Greens = "auto") -> tuple[RawFrame, GreenDifference | None]:
    """Make the two greens of a Bayer frame agree if they clearly differ; return the frame, and by how much they did.

    The difference is None for other patterns, or if it cannot be measured.
    """
    if frame.cfa not in CFA.__members__:
        return frame, None

    difference = bayer.measure_greens(frame.mosaic, frame.cfa)
    if difference is None or not difference.significant or greens == "keep":
        return frame, difference
    return replace(frame, mosaic=bayer.balance_greens(frame.mosaic, frame.cfa, difference)), difference


def clip_below_zero(mosaic: Tensor, frame: RawFrame) -> float:
    """Clip, in place, what a digital number cannot hold; return the share of clipped sites."""
    if frame.floating:
        return 0.0

    cell = cell_of_planes(frame.cfa)
    size = len(cell)

    below = 0
    for i, j in product(range(size), repeat=2):
        plane = mosaic[0, i::size, j::size]
        black = frame.black[cell[i, j]]
        step = 1.0 / (frame.white - black)
        lowest = -black / (frame.white - black)
        below += int((plane < lowest - 0.5 * step).sum())
        plane.clamp_(min=lowest)

    return below / mosaic.numel()
