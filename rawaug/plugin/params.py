"""A training pair, and the parameters that were drawn for it: they go to a file and back, and replay the pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug.files import read_tensors, write_tensors
from rawaug.isp.config import ISPParams

_KIND = "augment_params"


class AugmentParams(NamedTuple):
    """Everything that was drawn for a batch of B pictures; for one picture of a Dataset the tensors have no leading B.

    Args:
        isp: camera settings.
        noise: levels and seeds of the noise.
        crop: ``(B, 5)`` top and left of the picture in its full frame, height and width of the frame, and the view,
            which is how the picture was turned after the crop (see :func:`rawaug.bayer.turn`). With a zoom it is
            ``(B, 6)``, and the last is the number of rows that were enlarged to the crop.
        extras: with the target ``"srgb"`` ``demosaicing`` (its number), with JPEG ``quality``, with finishing
            ``chroma_420``, each ``(B,)``, and ``finish`` ``(B, 8)``; with bursts ``motion`` ``(B, N, 3)`` and
            ``frame_seed`` ``(B, N)``. Else it is empty.
    """

    isp: ISPParams
    noise: dict[str, Tensor]
    crop: Tensor
    extras: dict[str, Tensor]

    def map(self, change: Callable[[Tensor], Tensor]) -> AugmentParams:
        """Apply a function to every tensor.

        Of a batch, ``params.map(lambda t: t[0])`` gives the parameters of the first picture, from ``(B, ...)`` to
        ``(...)``.
        """
        noise, extras = ({name: change(value) for name, value in drawn.items()} for drawn in (self.noise, self.extras))
        return AugmentParams(ISPParams(*map(change, self.isp)), noise, change(self.crop), extras)

    def tensors(self) -> dict[str, Tensor]:
        """The parameters as a flat dict, to store with a batch; :meth:`from_tensors` reads it back."""
        groups = {"isp": self.isp._asdict(), "noise": self.noise, "extras": self.extras}
        flat = {f"{group}.{name}": value for group, drawn in groups.items() for name, value in drawn.items()}
        return flat | {"crop": self.crop}

    @classmethod
    def concatenate(cls, parts: Sequence[AugmentParams]) -> AugmentParams:
        """Join the parameters of several batches ``(B, ...)`` to those of one."""
        flat = [params.tensors() for params in parts]
        return cls.from_tensors({name: torch.cat([tensors[name] for tensors in flat]) for name in flat[0]})

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> AugmentParams:
        """Read the flat dict of :meth:`tensors`, ``(B, ...)`` or of one picture; ValueError if a tensor is missing."""
        missing = {"crop", *(f"isp.{name}" for name in ISPParams._fields)} - set(tensors)
        if missing:
            raise ValueError(f"not the parameters of an augmentation: {', '.join(sorted(missing))} missing")
        isp = ISPParams(*(tensors[f"isp.{name}"] for name in ISPParams._fields))
        noise, extras = (
            {name.removeprefix(group): value for name, value in tensors.items() if name.startswith(group)}
            for group in ("noise.", "extras.")
        )
        return cls(isp, noise, tensors["crop"], extras)


class RawPair(NamedTuple):
    """A training pair, packed R, Gr, Gb, B; without the leading B where it comes from a Dataset.

    RAW of other patterns than Bayer's (:mod:`rawaug.bayer`) is ``(B, 1, H, W)`` in all three. Other targets and bursts
    have the shapes that :class:`rawaug.RawAugment` states.

    Args:
        noisy: ``(B, 4, H/2, W/2)``, at most 1, not clipped at 0.
        clean: ``(B, 4, H/2, W/2)``, at most 1: the sensor saturates there.
        variance: ``(B, 4, H/2, W/2)`` noise variance computed from the noisy signal, as a network sees it.
        params: replays the pair.
    """

    noisy: Tensor
    clean: Tensor
    variance: Tensor
    params: AugmentParams

    def map(self, change: Callable[[Tensor], Tensor]) -> RawPair:
        """Apply a function to every tensor; ``pair.map(lambda t: t[0])`` is the first pair of ``(B, 4, H/2, W/2)``."""
        return RawPair(change(self.noisy), change(self.clean), change(self.variance), self.params.map(change))

    def as_dict(self, keys: Sequence[str]) -> dict[str, Any]:
        """The first of noisy, clean, variance and params as a dict with these keys, such as ``("lq", "gt")``."""
        return dict(zip(keys, self, strict=False))


def require_keys(keys: Sequence[str] | None) -> tuple[str, ...] | None:
    """Check the keys of :meth:`RawPair.as_dict`; ValueError if they are not 1 to 4 different names."""
    if keys is None:
        return None
    named = () if isinstance(keys, str) else tuple(keys)
    if not 1 <= len(named) <= len(RawPair._fields) or len(set(named)) < len(named):
        wanted = ", ".join(RawPair._fields)
        raise ValueError(f'keys are different names for {wanted}, in this order, as ("noisy", "clean"); got {keys!r}')
    return named


def save_params(params: AugmentParams, path: str | Path) -> None:
    """Write parameters to a safetensors file, which is replaced as a whole."""
    tensors = {name: value.detach().cpu() for name, value in params.tensors().items()}
    write_tensors(tensors, {"format": "rawaug", "kind": _KIND}, path)


def load_params(path: str | Path) -> AugmentParams:
    """Read parameters that :func:`save_params` has written, on the CPU.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds something else.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file of parameters")
    header, tensors = read_tensors(path, "save the parameters again")
    kind = header.get("kind", "no rawaug parameters")
    if kind != _KIND:
        raise ValueError(f"{path}: holds {kind}, not the parameters of an augmentation")
    try:
        return AugmentParams.from_tensors(tensors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
