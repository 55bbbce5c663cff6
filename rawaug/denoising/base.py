r"""The interface of denoisers for every kind of image, and their input.

    result = y + s (f(y) - y)

A denoiser is made by ``of`` from a name, a file, a filter or a network. It says which kind of image it takes, and is
called with a noisy one. :class:`rawaug.RawDenoiser` takes RAW, and :class:`rawaug.denoising.pictures.PictureDenoiser`
takes developed pictures. This module holds what both share: where and how precisely a network computes, and the check
of its result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from denoisers.classical import FILTERS
from denoisers.files import find_denoiser, list_shipped
from denoisers.published import Image, NetworkFile, find_image_kind, read_network
from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.files import read_header
from rawaug.kernels.runtime import find_device, has_fast_bfloat16
from rawaug.progress import progress
from rawaug.registry import suggest

Levels = tuple[float, float]
"""Levels of noise: (shot_var, read_var)."""
CPU = torch.device("cpu")
IMAGES: dict[Image, str] = {"raw": "RAW", "srgb": "developed pictures"}
"""The names of the kinds of image in messages."""


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
    def of(cls, image: Tensor, levels: Levels, cfa: CFA | str) -> Noisy:
        """Make one of packed RAW ``(1, 4, h, w)`` or a mosaic ``(1, 1, H, W)``, with the variance of these levels."""
        return cls(image, noise_variance(image, *levels), levels, bayer.canonical_cfa(cfa))


D = TypeVar("D", bound="ImageDenoiser")


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
            where = find_device(str(device))
            network.to(where, memory_format=torch.channels_last)  # type: ignore[call-overload]
            mixed = precision == "auto" and getattr(network, "mixed", False) and has_fast_bfloat16(where)
            changes = {"device": where, "mixed": mixed, **changes}

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

    def _precision(self) -> torch.autocast:
        """Return the precision in which a network computes, as a context."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.mixed)

    def _require_sound(self, denoised: Tensor, noisy: Tensor, expected: Sequence[int]) -> Tensor:
        """Return the result for a noisy image if it has the expected shape and is finite; else raise an error."""
        if tuple(denoised.shape) != tuple(expected) or (self.checked and not denoised.isfinite().all()):
            shapes = f"{tuple(denoised.shape)} for {tuple(noisy.shape)}"
            raise ValueError(f"{self.name}: the result is not finite, or of another shape: {shapes}")
        return denoised


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


def progress_by(unit: str) -> Callable[[Sequence[Any]], Iterable[Any]]:
    """Make a function that iterates over the parts of a frame, such as tiles, with progress if there are several."""

    def iterate(parts: Sequence[Any]) -> Iterable[Any]:
        if len(parts) == 1:
            return iter(parts)
        return progress(parts, label="frame", unit=unit)

    return iterate
