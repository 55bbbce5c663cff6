r"""Denoisers of every kind of image, and those of RAW, whatever they are made of.

    d = f(y, v),    v = shot_var max(y, 0) + read_var,    result = y + s (d - y)

A denoiser is made by ``of`` from a name, a file, a filter, a network or a function f. It says which kind of image it
takes, and is called with a noisy one. :class:`RawDenoiser` takes RAW, and
:class:`rawaug.denoising.pictures.PictureDenoiser` takes developed pictures.

:class:`RawDenoiser` holds what is the same for everything of RAW: tiles, the CFA that f was trained for, the
self-ensemble, device and precision, and the strength s. A mosaic with a pattern other than f's is extended by a
mirrored line on the sides where the patterns differ, and the result is cropped.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

import denoisers
from denoisers.classical import FILTERS, Stabilised
from denoisers.files import DEFAULT, find_denoiser, list_shipped
from denoisers.mosaic import BayerAdapter, MosaicDRUNet, denoise_mosaic
from denoisers.network import DENOISERS
from denoisers.onnx import STRIDE, OnnxNetwork
from denoisers.patterns import crop_to_pattern, extend_to_pattern
from denoisers.published import Image, NetworkFile, find_image_kind, read_network
from denoisers.tiles import TILE
from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.denoising.convolutions import has_fast_bfloat16
from rawaug.files import read_header, sha256
from rawaug.io import RawFrame
from rawaug.kernels.runtime import find_device
from rawaug.progress import progress
from rawaug.registry import Spec, spec_label, split_spec, suggest

Levels = tuple[float, float]
"""Levels of noise: (shot_var, read_var)."""
CPU = torch.device("cpu")
IMAGES: dict[Image, str] = {"raw": "RAW", "srgb": "developed pictures"}
"""The names of the kinds of image in messages."""
Model = Callable[[Tensor, Tensor | None], Tensor]
"""``model(noisy, variance) -> denoised``, each ``(B, 4, h, w)``, perhaps with a ``stride`` and an ``upscale``."""
FILTER_TILES = (512, 32)
"""The side and overlap of a filter's tiles, in packed pixels; the filters reach 8 pixels, and BM3D reaches 20."""
D = TypeVar("D", bound="ImageDenoiser")


class Noisy(NamedTuple):
    """The input of a denoiser: an image, and whatever is known of its noise.

    Attributes:
        image: packed RAW ``(1, 4, h, w)``, white at 1, not clipped at black; for patterns other than Bayer's, the
            mosaic ``(1, 1, H, W)``; or developed sRGB ``(1, 3, H, W)``.
        variance: variance of the noise of each value, with the shape of ``image``; None if it is not known.
        levels: (shot_var, read_var) if the variance is ``shot_var max(image, 0) + read_var``.
        cfa: the pattern of packed RAW or of the mosaic.
    """

    image: Tensor
    variance: Tensor | None = None
    levels: Levels | None = None
    cfa: str = CFA.RGGB

    @classmethod
    def of(cls, image: Tensor, levels: Levels | None, cfa: CFA | str) -> Noisy:
        """Make one of packed RAW ``(1, 4, h, w)`` or a mosaic ``(1, 1, H, W)``, with the variance of these levels."""
        variance = None if levels is None else noise_variance(image, *levels)
        return cls(image, variance, levels, bayer.canonical_cfa(cfa))


@dataclass(frozen=True, kw_only=True)
class ImageDenoiser(ABC):
    """Anything that denoises one kind of image; made by :meth:`of`, and changed by :func:`dataclasses.replace`.

    Attributes:
        name: in tables.
        network: the network that computes, if it is a PyTorch network.
        info: what its file says of its training.
        reads_levels: whether noise levels make a difference.
        views: number of views of the image that are averaged, at that many times the work.
        strength: how much of the noise is removed, 1 by default.
        device: where it runs.
        mixed: whether it computes in bfloat16.
        checked: whether a result that is not finite is an error; a training that diverged is scored as it is.
        settings: everything that its results depend on, as JSON.
    """

    takes: ClassVar[Image]
    """The kind of image that it takes."""

    default: ClassVar[str]
    """The shipped denoiser if none is named."""

    files: ClassVar[str]
    """The files of networks that can be named, for messages."""

    name: str
    network: nn.Module | None = field(default=None, repr=False)
    info: Mapping[str, Any] = field(default_factory=dict, repr=False)
    reads_levels: bool = True
    views: int = 1
    strength: float = 1.0
    device: torch.device = CPU
    mixed: bool = False
    checked: bool = True
    settings: dict[str, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls: type[D],
        spec: Any,
        device: str | torch.device = "cpu",
        precision: Literal["full", "auto"] = "full",
        **changes: Any,
    ) -> D:
        """Make the denoiser that a name, a file or an object stands for. Nothing is imported by name.

        Args:
            spec: see the class.
            device: auto, cpu, cuda, ...: where a PyTorch network runs. Everything else runs on the CPU.
            precision: ``"auto"`` computes in bfloat16 where that is fast and costs the network less than 0.05 dB.
            changes: attributes in place of those of the denoiser, such as ``name``, ``views``, ``strength``.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if there is no such denoiser, it takes another kind of image, or its file is damaged.
            ImportError: if a library that it needs is not installed.
        """
        denoiser = spec if isinstance(spec, cls) else cls._resolve(spec, changes.get("name"))
        network = denoiser.network
        if network is not None:
            target = find_device(str(device))
            network.to(target, memory_format=torch.channels_last)  # type: ignore[call-overload]
            mixed = precision == "auto" and getattr(network, "mixed", False) and has_fast_bfloat16(target)
            changes = {"device": target, "mixed": mixed, **changes}

        return replace(denoiser, **changes)

    @classmethod
    @abstractmethod
    def _resolve(cls: type[D], spec: Any, name: str | None) -> D:
        """Find the denoiser of an object or a name, on the CPU; it will be called ``name``, if that is given."""

    @classmethod
    def shipped(cls) -> list[str]:
        """List the names of the shipped networks that take this kind of image."""
        names = []
        for name in list_shipped():
            if find_image_kind(read_header(find_denoiser(name))) == cls.takes:
                names.append(name)
        return names

    @abstractmethod
    def __call__(self, noisy: Noisy) -> Tensor:
        """Denoise the image; the result is on the CPU."""

    def _compute(self, run: Callable[..., Tensor], *inputs: Tensor | None, shape: Sequence[int]) -> Tensor:
        """Call ``run`` on the device and in the precision of this denoiser.

        Returns:
            The result, on the CPU; an error is raised if it has another shape, or is not finite.
        """
        moved = [value if value is None else value.to(self.device) for value in inputs]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.mixed):
            denoised = run(*moved).cpu()

        if tuple(denoised.shape) != tuple(shape) or (self.checked and not denoised.isfinite().all()):
            shapes = f"{tuple(denoised.shape)}, expected {tuple(shape)}"
            raise ValueError(f"{self.name}: the result is not finite, or of another shape: {shapes}")
        return denoised


def open_denoiser(
    kind: type[D], spec: Any, strength: float = 1.0, self_ensemble: bool = False, device: str = "auto"
) -> D:
    """Open a denoiser of this kind; one that is open is changed only as far as an argument differs from its default."""
    changes: dict[str, Any] = {}
    if strength != 1.0:
        changes["strength"] = strength
    if self_ensemble:
        changes["views"] = 8
    if isinstance(spec, kind) and not changes and device == "auto":
        return spec
    return kind.of(spec, device, "auto", **changes)


def read_named(spec: str | Path, kind: type[ImageDenoiser]) -> NetworkFile:
    """Read the network of a ``.safetensors`` file or of a shipped name, for denoisers of this kind.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if there is no such name, or the network takes another kind of image.
    """
    if not Path(spec).suffix and str(spec) not in list_shipped():
        names = [*kind.shipped(), *FILTERS]
        nearest = suggest(str(spec), names)
        raise ValueError(f"{spec}: no such denoiser{nearest}; give one of {', '.join(names)}, {kind.files}")

    file = read_network(find_denoiser(spec))
    if file.image != kind.takes:
        names = kind.shipped()
        raise ValueError(
            f"{spec}: denoises {IMAGES[file.image]}, not {IMAGES[kind.takes]}; give one of {', '.join(names)}"
        )
    return file


def each_with_progress(parts: Sequence[Any], unit: str = "tile") -> Iterable[Any]:
    """Iterate over the parts of a frame, with progress if there are several."""
    if len(parts) == 1:
        return parts
    bar: Iterable[Any] = progress(parts, label="frame", unit=unit)
    return bar


@dataclass(frozen=True, kw_only=True)
class RawDenoiser(ImageDenoiser):
    """Anything that denoises RAW; made by :meth:`of`, and changed by :func:`dataclasses.replace`.

    :meth:`of` takes the name of a shipped denoiser; a ``.safetensors`` file of rawaug, or a published one of PMRID,
    BF-DnCNN or PBRID; an ``.onnx`` file; a classical filter by its name, or ``{"name": ..., "settings": {...}}``; a
    network ``model(noisy, variance)`` or ``model(noisy)`` of packed RAW ``(B, 4, h, w)``; or a function of the same
    arguments, which gets whole frames.

    Attributes:
        name: in tables.
        model: ``model(levels)`` is the function f that denoises a piece of packed RAW; levels may be None.
        network: the network that computes, if it is a PyTorch network.
        cfa: the pattern that it was trained for; None if it works on any of Bayer's.
        any_pattern: the network of mosaics of any pattern, such as X-Trans, with the planes of their colours; packed
            RAW goes through ``model``. None if it denoises only Bayer mosaics.
        demosaics: whether the result for packed RAW is linear camera RGB ``(1, 3, 2h, 2w)``.
        info: what its file says of its training.
        reads_levels: whether noise levels make a difference.
        tiles: side and overlap of the pieces, in packed pixels, where None is the default of
            :func:`denoisers.denoise_tiles`; a single None denoises a frame in one piece.
        views: number of views of a self-ensemble, 4 or 8, at that many times the work; 1 for none.
        strength: s in [0, 1]; ``(1 - s)^2`` of the noise's variance is left.
        device: where it runs.
        mixed: whether it computes in bfloat16.
        checked: whether a result that is not finite is an error; a training that diverged is scored as it is.
        settings: everything that its results depend on, as JSON.

    Example:
        >>> denoiser = RawDenoiser.of("NonLocalMeans")
        >>> denoiser(Noisy.of(torch.rand(1, 4, 32, 48), (1e-3, 1e-5), "RGGB")).shape
        torch.Size([1, 4, 32, 48])
    """

    takes: ClassVar[Image] = "raw"
    default: ClassVar[str] = DEFAULT
    files: ClassVar[str] = "a .safetensors or an .onnx"
    model: Callable[[Levels | None], Model] = field(repr=False)
    cfa: CFA | None = None
    any_pattern: MosaicDRUNet | None = field(default=None, repr=False)
    demosaics: bool = False
    tiles: tuple[int, int | None] | None = (TILE, None)

    def __post_init__(self) -> None:
        if self.views not in (1, 4, 8):
            raise ValueError(f"views must be 1, 4 or 8, got {self.views!r}")
        if self.demosaics and self.strength != 1.0:
            raise ValueError(f"{self.name}: takes no strength=; the noisy frame has no full colour to mix in")
        if not 0.0 <= self.strength <= 1.0:
            raise ValueError(f"strength must be between 0 and 1, got {self.strength}; noise= takes higher levels")

    @classmethod
    def _resolve(cls, spec: Any, name: str | None) -> RawDenoiser:
        if isinstance(spec, nn.Module):
            return _of_network(type(spec).__name__, spec, {}, CFA.RGGB)
        if callable(spec):
            return _of_function(spec, name)
        if isinstance(spec, Mapping) or str(spec) in FILTERS:
            return _of_filter(spec)

        path = Path(spec)
        if path.suffix == ".onnx":
            network = OnnxNetwork(path)
            denoiser = _of_network(path.stem, network, network.info, CFA(network.info.get("cfa", "RGGB")))
            denoiser = replace(denoiser, network=None)  # ONNX Runtime computes on the CPU
        else:
            file = read_named(spec, cls)
            path = file.path
            denoiser = _of_network(file.name, file.network, file.info, file.cfa)
        return replace(denoiser, settings={"denoiser": path.stem, "denoiser_sha256": sha256(path)})

    def takes_pattern(self, cfa: str) -> bool:
        """Tell whether it takes mosaics of a pattern: any of Bayer's, and others with ``any_pattern``."""
        return cfa in CFA.__members__ or self.any_pattern is not None

    def require_mosaic(self) -> RawDenoiser:
        """Return this denoiser; raise ValueError if it gives full colour, which cannot be compared with a mosaic."""
        if self.demosaics:
            raise ValueError(f"{self.name}: demosaics, too; rawaug run demosaic --denoiser.start {self.name} scores it")
        return self

    @torch.inference_mode()
    def __call__(self, noisy: Noisy) -> Tensor:
        """Denoise packed RAW ``(1, 4, h, w)`` to a result on the CPU; full colour if it ``demosaics``.

        A mosaic ``(1, 1, H, W)`` of a pattern other than Bayer's remains one. ValueError is raised if this denoiser
        takes none, or if the result has another shape or, with ``checked``, is not finite.
        """
        if noisy.image.shape[1] == 1:
            denoised = self._denoise_mosaic(noisy)
        else:
            denoised = self._denoise_packed(noisy)

        if self.strength == 1.0:
            return denoised.to(noisy.image.dtype)
        return noisy.image.lerp(denoised.clamp(max=1.0), self.strength)

    def _denoise_packed(self, noisy: Noisy) -> Tensor:
        # The pattern that it was trained for.
        cfa = CFA(noisy.cfa)
        trained_for = self.cfa or cfa
        image = extend_to_pattern(noisy.image, cfa, trained_for)
        variance = noisy.variance
        if variance is not None:
            variance = extend_to_pattern(variance, cfa, trained_for)

        # Tiles, and views of them.
        run = self.model(noisy.levels)
        if self.tiles is not None:
            tile, overlap = self.tiles
            run = partial(denoisers.denoise_tiles, run, tile=tile, overlap=overlap, each=each_with_progress)
        if self.views > 1:
            each = partial(each_with_progress, unit="view group")
            run = denoisers.SelfEnsemble(run, trained_for, views=self.views, each=each)

        shape = tuple(image.shape)
        if self.demosaics:
            shape = (1, 3, 2 * shape[2], 2 * shape[3])
        denoised = self._compute(run, image, variance, shape=shape)
        return crop_to_pattern(denoised, trained_for, cfa)

    def _denoise_mosaic(self, noisy: Noisy) -> Tensor:
        if self.any_pattern is None:
            advice = "use rawaug-xtrans, or weights of rawaug run any"
            raise ValueError(f"{self.name}: is for Bayer mosaics, not {noisy.cfa}; {advice}")
        if self.views > 1 or self.tiles is None:
            raise ValueError(f"the self-ensemble: is for Bayer mosaics, not {noisy.cfa}; omit it")
        if noisy.variance is None:
            raise ValueError(f"{self.name}: needs the variance of the noise")

        tiles = partial(denoisers.denoise_tiles, self.any_pattern, tile=2 * self.tiles[0], each=each_with_progress)
        run = partial(denoise_mosaic, tiles, cfa=noisy.cfa)
        return self._compute(run, noisy.image, noisy.variance, shape=noisy.image.shape)

    def frame(self, frame: RawFrame, levels: Levels | None) -> Tensor:
        """Denoise the mosaic ``(1, H, W)`` of a frame, to at most 1; full colour ``(3, H, W)`` if it ``demosaics``.

        ``levels`` may be None where :attr:`reads_levels` is False.
        """
        noisy = Noisy.of(bayer.pack_if_bayer(frame.mosaic[None], frame.cfa), levels, frame.cfa)
        return bayer.unpack_if_packed(self(noisy), frame.cfa)[0].clamp(max=1.0)


# -- by what it is made of ---------------------------------------------------------------------------------------------


def shipped_of_mosaics() -> list[str]:
    """List the names of the shipped networks that denoise the mosaic and leave demosaicing to others."""
    names = []
    for name in RawDenoiser.shipped():
        model = read_header(find_denoiser(name))["model"]
        if DENOISERS[model].upscale == 1:
            names.append(name)
    return names


def require_classical(specs: Sequence[Spec]) -> None:
    """Raise ValueError if a classical denoiser, one of its settings or its library does not exist."""
    for spec in specs:
        reason = FILTERS.make(spec).missing()
        if reason is not None:
            raise ValueError(f"classical: {split_spec(spec)[0]}: {reason}")


def denoiser_file(spec: str | Path) -> Path | None:
    """Find the file of a network that a name or a path stands for; return None for a filter or a function."""
    if Path(spec).suffix in (".safetensors", ".onnx") or str(spec) in list_shipped():
        return find_denoiser(spec)
    return None


def _of_network(name: str, network: nn.Module, info: Mapping[str, Any], cfa: CFA | None) -> RawDenoiser:
    """Make the denoiser of a network; unless it says so, it takes a variance if its ``forward`` has two arguments."""
    if isinstance(network, MosaicDRUNet):
        return replace(_of_network(name, BayerAdapter(network), info, cfa), any_pattern=network)

    reads = getattr(network, "reads_variance", None)
    if reads is None:
        reads = _takes_two(network.forward)
        network = _Foreign(network, reads)

    evaluated = network.eval()
    return RawDenoiser(
        name=name,
        model=lambda levels: evaluated,
        network=evaluated,
        cfa=cfa,
        info=info,
        demosaics=getattr(evaluated, "upscale", 1) != 1,
        reads_levels=bool(reads),
        tiles=(getattr(evaluated, "tile", TILE), None),
    )


class _Foreign(nn.Module):
    """A network that states no stride, and takes only noisy RAW unless it ``reads`` the variance."""

    def __init__(self, network: nn.Module, reads: bool) -> None:
        super().__init__()
        self.network = network
        self.reads = reads
        self.stride = getattr(network, "stride", STRIDE)
        self.upscale = getattr(network, "upscale", 1)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        arguments = (noisy, variance) if self.reads else (noisy,)
        denoised: Tensor = self.network(*arguments)
        return denoised


def _of_filter(spec: Spec) -> RawDenoiser:
    require_classical([spec])
    denoiser = FILTERS.make(spec)
    stabilised = Stabilised(denoiser)

    def model(levels: Levels | None) -> Model:
        """Take noise of an unknown law for white noise, at the mean level of its map."""
        if levels is None:
            return denoiser
        shot_var, read_var = levels
        return partial(stabilised, shot_var=shot_var, read_var=read_var)

    return RawDenoiser(name=spec_label(spec), model=model, tiles=FILTER_TILES, settings={"classical": spec})


def _of_function(function: Callable[..., Any], name: str | None) -> RawDenoiser:
    name = name or str(getattr(function, "__name__", type(function).__name__))
    reads = _takes_two(function)

    def run(noisy: Tensor, variance: Tensor | None) -> Tensor:
        arguments: list[Tensor | None] = [noisy.clone()]
        if reads:
            arguments.append(variance if variance is None else variance.clone())
        try:
            return torch.as_tensor(function(*arguments)).to(noisy)
        except Exception as error:  # anybody's function
            raise ValueError(f"{name}: {type(error).__name__}: {' '.join(str(error).split())}") from error

    return RawDenoiser(name=name, model=lambda levels: run, reads_levels=reads, tiles=None)


def _takes_two(function: Callable[..., Any]) -> bool:
    """Tell whether a function must also be given the variance, besides noisy RAW."""
    count = 0
    for parameter in inspect.signature(function).parameters.values():
        is_positional = parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        count += is_positional and parameter.default is parameter.empty
    return count > 1
