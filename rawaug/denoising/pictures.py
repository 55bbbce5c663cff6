r"""Denoisers of developed pictures, sRGB ``(1, 3, H, W)`` in [0, 1], beside :class:`rawaug.RawDenoiser` for RAW.

.. math:: d = x + w\, (f(x, s \sigma) - x)

A network f is told the level of the noise, its standard deviation :math:`\sigma`, and a share w of its correction is
applied. Both are estimated from the picture, see :mod:`rawaug.denoising.picture_levels`. The strength s is 1 unless the
user says otherwise.

A network that estimates the level sees the picture twice, upright and turned by a quarter, and the two results are
averaged. This gains half of what the self-ensemble does, which is the mean of eight views, as for RAW.

Files are denoised to pictures of the same kind, with their EXIF, ICC profile and orientation.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

import denoisers
from denoisers.classical import FILTERS
from denoisers.ffdnet import Refilled
from denoisers.published import Image
from rawaug import bayer
from rawaug.denoising.denoiser import ImageDenoiser, Noisy, each_with_progress, open_denoiser, read_named
from rawaug.denoising.drawn import explain_drawn
from rawaug.denoising.folder import Files
from rawaug.denoising.picture_levels import estimate_level, white_level
from rawaug.errors import escape
from rawaug.files import files_below, write_bytes
from rawaug.io import RawFrame
from rawaug.io.content import RAW_EXTENSIONS, Listing, list_files, picture_extensions
from rawaug.io.isolated import isolated
from rawaug.io.stored import PICTURE_FORMATS, StoredPicture, read_stored, write_stored
from rawaug.registry import Spec, spec_label

_TILE = 1024
"""Side of a tile; without tiles, the default denoiser needs more than 2 GB for 12 megapixels."""
_LOWEST_OF_FILTERS = 1e-4
"""The lowest level that a filter is told, since it divides by it."""
_REFILL = "+refill"
"""Behind a network's name: its pixels are denoised apart and refilled."""
VIEWS = {1: (0,), 2: (0, 5), 4: range(4), 8: range(bayer.N_VIEWS)}
"""The views that are averaged, by the number of views."""
LINEAR = (".exr",)
"""The extensions of pictures of linear light."""
_SUBSTITUTE = ".png"
"""The format of results of pictures whose own format is read but not written; it loses nothing."""


@dataclass(frozen=True, kw_only=True)
class PictureDenoiser(ImageDenoiser):
    """Anything that denoises pictures.

    :meth:`of` takes the name of a shipped denoiser of pictures or of a classical filter, ``{"name": ..., "settings":
    {...}}``, a ``.safetensors`` of rawaug or of FFDNet's authors, or a network of sRGB; with ``@15`` behind a name, it
    is told this level, in units of 1/255, every time. With ``+refill`` before it, a network for white noise works as
    :class:`denoisers.ffdnet.Refilled`, such as ``ffdnet_color.safetensors+refill@50``.

    A picture whose level is estimated stays as it is if it was drawn, see :mod:`rawaug.denoising.drawn`.

    Attributes:
        run: ``run(srgb, level) -> srgb``, called on ``device`` with the level that is told or estimated.
        estimate: ``estimate(srgb) -> level, share`` where no level is told, see
            :func:`rawaug.denoising.picture_levels.estimate_level`.
        level: the level that it is told every time; None for the estimate.
        views: number of flips and quarter turns of the picture that are averaged, 1, 2, 4 or 8; by default as many as
            the network asks for.
        strength: factor on the estimated level, 0 to 10: 2 removes more, 0.5 less, 0 nothing.

    The other attributes are those of :class:`rawaug.denoising.denoiser.ImageDenoiser`.

    Example:
        >>> denoiser = PictureDenoiser.of("NonLocalMeans@10")
        >>> denoiser(Noisy(torch.rand(1, 3, 32, 48))).shape
        torch.Size([1, 3, 32, 48])
    """

    takes: ClassVar[Image] = "srgb"
    default: ClassVar[str] = "rawaug-srgb"
    files: ClassVar[str] = "or a .safetensors of rawaug run srgb or of FFDNet's authors"

    run: Callable[[Tensor, float], Tensor] = field(repr=False)
    estimate: Callable[[Tensor], tuple[float, float]] = field(repr=False)
    level: float | None = None

    def __post_init__(self) -> None:
        if self.views not in VIEWS:
            raise ValueError(f"views must be 1, 2, 4 or 8, got {self.views!r}")
        if not 0.0 <= self.strength <= 10.0:
            raise ValueError(f"strength must be between 0 and 10, got {self.strength}")
        if self.level is not None and not self.reads_levels:
            raise ValueError(f"{self.name}: is told no level; leave out what stands after @")

    @classmethod
    def _resolve(cls, spec: Any, name: str | None) -> PictureDenoiser:
        if isinstance(spec, nn.Module):
            return _of_network(type(spec).__name__, spec, {})
        if isinstance(spec, Mapping):
            return _of_filter(spec)

        stem, level = _split_level(str(spec))
        if stem in FILTERS:
            denoiser = _of_filter(stem)
        else:
            file = read_named(stem.removesuffix(_REFILL), cls)
            denoiser = _of_network(file.name, file.network, file.info)
            if stem.endswith(_REFILL):
                denoiser = _of_network(f"{file.name}, refilled", Refilled(file.network), file.info)

        if level is None:
            return denoiser
        return replace(denoiser, name=f"{denoiser.name}, told {255.0 * level:g}", level=level)

    def __call__(self, noisy: Noisy) -> Tensor:
        """sRGB ``(1, 3, H, W)`` denoised, on the CPU, cut to [0, 1]."""
        return self.denoise(noisy.image)[0]

    @torch.inference_mode()
    def denoise(self, srgb: Tensor) -> tuple[Tensor, str | None]:
        """Denoise a picture ``(1, 3, H, W)`` unless it was drawn.

        Returns:
            The result, on the CPU, cut to [0, 1]; and why it is the picture as it was, None if it is not.
        """
        if self.reads_levels and self.level is None:
            kept = explain_drawn(srgb)
            if kept is not None:
                return srgb.clone(), kept

        return self._compute(self._average_views, srgb, shape=srgb.shape).clamp_(0.0, 1.0), None

    def _average_views(self, srgb: Tensor) -> Tensor:
        total = torch.zeros_like(srgb)
        for view in VIEWS[self.views]:
            denoised = self._denoise(bayer.turn(srgb, view).contiguous())
            total += bayer.turn_back(denoised, view)
        return total.div_(self.views)

    def _denoise(self, srgb: Tensor) -> Tensor:
        """One view of the picture at the level that is told, or at the one that is estimated."""
        if self.reads_levels and self.level is None and self.strength == 0.0:
            return srgb

        level, share = self.level or 0.0, 1.0
        if self.reads_levels and self.level is None:
            level, share = self.estimate(srgb)
            level *= self.strength
        denoised = self.run(srgb, level)
        if self.reads_levels:
            torch.lerp(srgb, denoised, share, out=denoised)  # in place, since pictures are large
        return denoised


def _of_network(name: str, network: nn.Module, info: Mapping[str, Any]) -> PictureDenoiser:
    """A network of sRGB in tiles; one that reads levels is told the picture's."""
    network = network.eval()
    reads_levels = bool(getattr(network, "reads_variance", False))

    def run(srgb: Tensor, level: float) -> Tensor:
        """Denoise in tiles; a network that reads levels is told the deviation of the noise, 0 for unknown."""
        if not reads_levels:
            return denoisers.denoise_tiles(network, srgb, each=each_with_progress)
        variance = srgb.new_full((1, 1, 1, 1), level**2).expand_as(srgb)
        return denoisers.denoise_tiles(network, srgb, variance, tile=_TILE, each=each_with_progress).float()

    return PictureDenoiser(
        name=name,
        network=network,
        info=info,
        run=run,
        estimate=partial(estimate_level, network),
        reads_levels=reads_levels,
        views=getattr(network, "views", 1),
    )


def _of_filter(spec: Spec) -> PictureDenoiser:
    """A classical filter of white noise on the three colours, which is told scikit-image's estimate of its level."""
    denoiser = FILTERS.make(spec)

    def run(srgb: Tensor, level: float) -> Tensor:
        deviation = max(_LOWEST_OF_FILTERS, level)
        planes = (srgb[0] / deviation).permute(1, 2, 0).contiguous().numpy()
        return torch.from_numpy(deviation * denoiser.denoise(planes)).permute(2, 0, 1)[None].float()

    return PictureDenoiser(name=spec_label(spec), run=run, estimate=lambda srgb: (white_level(srgb), 1.0))


def _split_level(spec: str) -> tuple[str, float | None]:
    """Split ``NAME@15`` into a name and a level, white at 1; the level is None where there is none."""
    name, at, stated_level = spec.rpartition("@")
    if not at:
        return spec, None

    try:
        level = float(stated_level) / 255.0
    except ValueError:
        level = -1.0
    if not 0.0 <= level <= 1.0:
        raise ValueError(f"{spec}: the level after @ must be from 0 to 255, got {stated_level}")
    return name, level


# -- files -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DenoisedPicture:
    """What was done to a picture.

    Attributes:
        source, out: the files.
        deviation: that of the noise that was removed, in units of 1/255.
        seconds: how long it took.
        kept: why the picture was left as it is; None if it was denoised.
    """

    source: Path
    out: Path | None
    deviation: float
    seconds: float
    kept: str | None = None

    def __str__(self) -> str:
        if self.kept is not None:
            advice = "name a level, as in --denoiser rawaug-srgb@10, to denoise it"
            return f"{escape(self.out)}: left as it is, since {self.kept}; {advice}"
        return f"{escape(self.out)}: noise of {self.deviation:.1f} in 255 removed, {self.seconds:.1f} s"


class PictureFiles(Files[DenoisedPicture]):
    """Developed pictures, which are denoised to pictures with their EXIF, ICC profile and orientation.

    Args:
        denoiser: whatever :meth:`PictureDenoiser.of` takes; None stands for the shipped one.
        strength, self_ensemble, device: the factor on the estimated level, whether eight views are averaged, and where
            it runs.
    """

    what = "picture"
    formats = PICTURE_FORMATS
    format_advice = f"the source is a developed picture; its output is one of {', '.join(PICTURE_FORMATS)}"

    def __init__(
        self, denoiser: Any = None, strength: float = 1.0, self_ensemble: bool = False, device: str = "auto"
    ) -> None:
        if denoiser is None:
            denoiser = PictureDenoiser.default
        self.denoiser = open_denoiser(PictureDenoiser, denoiser, strength, self_ensemble, device)

    def listing(self, folder: Path) -> Listing:
        """List the pictures; one with the stem of a RAW file is left out, as the camera's own rendering of it."""
        extensions = tuple(extension for extension in picture_extensions() if extension not in LINEAR)
        listing = list_files(folder, extensions, "not a picture that is known")
        raw = {file.with_suffix("") for file in files_below(folder) if file.suffix.lower() in RAW_EXTENSIONS}
        beside = [file for file in listing.files if file.with_suffix("") in raw]
        for file in beside:
            advice = "pictures of the camera's own, beside the RAW files that they show; name one to denoise it"
            listing.leave_out("rendering", advice, file.suffix.lower())
            listing.files.remove(file)

        listing.advice["picture"] = "linear light; save it as a developed picture"
        return self.require_files(folder, listing, extensions)

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
        """Denoise a picture; see :meth:`rawaug.denoising.folder.Files.denoise`.

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

        batch, kept = self.denoiser.denoise(srgb[None])
        denoised = batch[0]
        deviation = 255.0 * (denoised - srgb).square().mean().sqrt().item()

        if out is not None and kept is not None and out.suffix.lower() == source.suffix.lower():
            write_bytes(source.read_bytes(), out)  # a JPEG that is written again has other pixels
        elif out is not None:
            write_stored(out, denoised, picture)
        return denoised, DenoisedPicture(source, out, deviation, time.perf_counter() - start, kept)
