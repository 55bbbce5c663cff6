r"""Denoisers of RAW, whatever they are made of.

    d = f(y, v),    v = shot_var max(y, 0) + read_var,    result = y + s (d - y)

:class:`RawDenoiser` holds what is the same for a network, an ONNX file, a filter and a function f: tiles, the CFA that
f was trained for, the self-ensemble, device and precision, and the strength s. A mosaic with a pattern other than f's
is extended by a mirrored line on the sides where the patterns differ, and the result is cropped.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

import denoisers
from denoisers.classical import FILTERS, Stabilised
from denoisers.files import DEFAULT, find_denoiser, list_shipped
from denoisers.mosaic import BayerAdapter, MosaicDRUNet, denoise_mosaic
from denoisers.network import DENOISERS
from denoisers.onnx import STRIDE, OnnxNetwork
from denoisers.patterns import crop_to_pattern, extend_to_pattern
from denoisers.published import Image
from denoisers.tiles import TILE
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.denoising.base import ImageDenoiser, progress_by, read_named
from rawaug.denoising.base import Levels as Levels
from rawaug.denoising.base import Noisy as Noisy
from rawaug.files import read_header, sha256
from rawaug.io import RawFrame
from rawaug.registry import Spec, spec_label, split_spec

Model = Callable[[Tensor, Tensor | None], Tensor]
"""``model(noisy, variance) -> denoised``, each ``(B, 4, h, w)``, perhaps with a ``stride`` and an ``upscale``."""
FILTER_TILES = (512, 32)
"""The side and overlap of a filter's tiles, in packed pixels; the filters reach 8 pixels, and BM3D reaches 20."""


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
    demosaics: ClassVar[bool] = False
    """Whether the result is linear camera RGB instead of a mosaic."""

    model: Callable[[Levels | None], Model] = field(repr=False)
    cfa: CFA | None = None
    tiles: tuple[int, int | None] | None = (TILE, None)

    def __post_init__(self) -> None:
        if self.views not in (1, 4, 8):
            raise ValueError(f"views must be 1, 4 or 8, got {self.views!r}")
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
        return _of_file(spec)

    def takes_pattern(self, cfa: str) -> bool:
        """Tell whether it takes mosaics of a pattern: any of Bayer's; a :class:`MosaicDenoiser` also takes others."""
        return cfa in CFA.__members__

    def require_mosaic(self) -> RawDenoiser:
        """Return this denoiser; raise ValueError if it gives full colour, which cannot be compared with a mosaic."""
        return self

    @torch.inference_mode()
    def __call__(self, noisy: Noisy) -> Tensor:
        """Denoise packed RAW ``(1, 4, h, w)`` to a result on the CPU; a :class:`JointDenoiser` gives full colour.

        A mosaic ``(1, 1, H, W)`` of a pattern other than Bayer's remains one. ValueError is raised if this denoiser
        takes none, or if the result has another shape or, with ``checked``, is not finite.
        """
        if noisy.image.shape[1] == 1:
            denoised = self._of_mosaic(noisy)
        else:
            denoised = self._of_packed(noisy)

        if self.strength == 1.0:
            return denoised.to(noisy.image.dtype)
        return noisy.image.lerp(denoised.clamp(max=1.0), self.strength)

    def _of_packed(self, noisy: Noisy) -> Tensor:
        cfa = CFA(noisy.cfa)
        own = self.cfa or cfa
        image = extend_to_pattern(noisy.image, cfa, own)
        variance = noisy.variance
        if variance is not None:
            variance = extend_to_pattern(variance, cfa, own)

        run = self._whole(self.model(noisy.levels), own)
        denoised = self._run(run, image, variance, self._result_shape(image))
        return crop_to_pattern(denoised, own, cfa)

    def _result_shape(self, packed: Tensor) -> tuple[int, ...]:
        """Return the shape of the result for packed RAW."""
        return tuple(packed.shape)

    def _of_mosaic(self, noisy: Noisy) -> Tensor:
        advice = "use rawaug-xtrans, or weights of rawaug run any"
        raise ValueError(f"{self.name}: is for Bayer mosaics, not {noisy.cfa}; {advice}")

    def _run(self, run: Model, image: Tensor, variance: Tensor | None, expected: Sequence[int]) -> Tensor:
        """Call ``run`` on the device and in the precision of this denoiser, and check its result."""
        if variance is not None:
            variance = variance.to(self.device)
        with self._precision():
            denoised = run(image.to(self.device), variance).cpu()
        return self._require_sound(denoised, image, expected)

    def _whole(self, model: Model, cfa: CFA) -> Model:
        """Wrap the model in tiles, and those in the self-ensemble."""
        run = model
        if self.tiles is not None:
            tile, overlap = self.tiles
            run = partial(denoisers.denoise_tiles, model, tile=tile, overlap=overlap, each=progress_by("tile"))
        if self.views > 1:
            run = denoisers.SelfEnsemble(run, cfa, views=self.views, each=progress_by("view group"))
        return run

    def frame(self, frame: RawFrame, levels: Levels | None) -> Tensor:
        """Denoise the mosaic ``(1, H, W)`` of a frame, to at most 1; a :class:`JointDenoiser` gives full colour.

        ``levels`` may be None where :attr:`reads_levels` is False.
        """
        image = bayer.pack_if_bayer(frame.mosaic[None], frame.cfa)
        noisy = Noisy(image, cfa=frame.cfa)
        if levels is not None:
            noisy = Noisy.of(image, levels, frame.cfa)

        denoised = bayer.unpack_if_packed(self(noisy), frame.cfa)
        return denoised[0].clamp(max=1.0)


@dataclass(frozen=True, kw_only=True)
class MosaicDenoiser(RawDenoiser):
    """A denoiser for mosaics of every pattern, including X-Trans and Quad-Bayer.

    Attributes:
        of_any: the network, which takes a mosaic with the planes of its colours. Packed RAW goes through ``network``.

    The other attributes are those of :class:`RawDenoiser`, whose ``of`` makes it.
    """

    of_any: MosaicDRUNet = field(repr=False)

    def takes_pattern(self, cfa: str) -> bool:
        """Tell whether it denoises mosaics of a pattern: it takes every pattern."""
        return True

    def _of_mosaic(self, noisy: Noisy) -> Tensor:
        if self.views > 1 or self.tiles is None:
            raise ValueError(f"the self-ensemble: is for Bayer mosaics, not {noisy.cfa}; omit it")
        if noisy.variance is None:
            raise ValueError(f"{self.name}: needs the variance of the noise")

        pieces = partial(denoisers.denoise_tiles, self.of_any, tile=2 * self.tiles[0], each=progress_by("tile"))
        run = partial(denoise_mosaic, pieces, cfa=noisy.cfa)
        return self._run(run, noisy.image, noisy.variance, noisy.image.shape)


@dataclass(frozen=True, kw_only=True)
class JointDenoiser(RawDenoiser):
    """A denoiser that also demosaics, from packed RAW ``(1, 4, h, w)`` to linear camera RGB ``(1, 3, 2h, 2w)``.

    The attributes are those of :class:`RawDenoiser`, whose ``of`` makes it.
    """

    demosaics: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.strength != 1.0:
            raise ValueError(f"{self.name}: takes no strength=; the noisy frame has no full colour to mix in")

    def require_mosaic(self) -> RawDenoiser:
        """Raise ValueError, since its results cannot be compared with a mosaic."""
        raise ValueError(f"{self.name}: demosaics, too; rawaug run demosaic --denoiser.start {self.name} scores it")

    def _result_shape(self, packed: Tensor) -> tuple[int, ...]:
        height, width = packed.shape[-2:]
        return 1, 3, 2 * height, 2 * width


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


def _of_file(spec: str | Path) -> RawDenoiser:
    """Make the denoiser of a file, or of a shipped network by its name."""
    path = Path(spec)
    if path.suffix == ".onnx":
        network = OnnxNetwork(path)
        denoiser = _of_network(path.stem, network, network.info, CFA(network.info.get("cfa", "RGGB")))
        denoiser = replace(denoiser, network=None)  # ONNX Runtime computes on the CPU
    else:
        file = read_named(spec, RawDenoiser)
        path = file.path
        denoiser = _of_network(file.name, file.network, file.info, file.cfa)

    return replace(denoiser, settings={"denoiser": path.stem, "denoiser_sha256": sha256(path)})


def _of_network(name: str, network: nn.Module, info: Mapping[str, Any], cfa: CFA | None) -> RawDenoiser:
    """Make the denoiser of a network; unless it says so, it takes a variance if its ``forward`` has two arguments."""
    if isinstance(network, MosaicDRUNet):
        packed = _of_network(name, BayerAdapter(network), info, cfa)
        return MosaicDenoiser(of_any=network, **vars(packed))

    reads = getattr(network, "reads_variance", None)
    if reads is None:
        reads = _takes_two(network.forward)
        network = _Foreign(network, reads)

    evaluated = network.eval()
    kind = RawDenoiser if getattr(evaluated, "upscale", 1) == 1 else JointDenoiser
    return kind(
        name=name,
        model=lambda levels: evaluated,
        network=evaluated,
        cfa=cfa,
        info=info,
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
