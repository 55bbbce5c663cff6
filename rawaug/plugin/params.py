"""A training pair, and the parameters that were drawn for it. They can be saved and loaded, and reproduce the pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug.files import read_tensors, write_tensors
from rawaug.isp.config import ISPParams
from rawaug.isp.functional import as_float

_KIND = "augment_params"


class AugmentParams(NamedTuple):
    """Everything that was drawn for a batch of B pictures; for one picture of a Dataset the tensors have no leading B.

    Args:
        isp: camera settings.
        noise: levels and seeds of the noise.
        crop: ``(B, 5)`` top and left of the picture in its full frame, height and width of the frame, and the view,
            which says how the picture was turned after the crop (see :func:`rawaug.bayer.turn`). With a zoom it is
            ``(B, 6)``, and the last is the number of rows that were enlarged to the crop.
        extras: for the target ``"srgb"``, ``demosaicing`` (its number), ``quality`` with JPEG, and with finishing
            ``chroma_420``, each ``(B,)``, and ``finish`` ``(B, 8)``; with K pairs of further shots, ``shot_seed``
            ``(B, K)``; for bursts, ``motion`` ``(B, N, 3)`` and ``frame_seed`` ``(B, N)``. ``blur`` ``(B,)`` is the
            standard deviation in pixels by which light is blurred, if it is. Otherwise it is empty.
    """

    isp: ISPParams
    noise: dict[str, Tensor]
    crop: Tensor
    extras: dict[str, Tensor]

    def map(self, change: Callable[[Tensor], Tensor]) -> AugmentParams:
        """Apply a function to every tensor.

        For a batch, ``params.map(lambda t: t[0])`` gives the parameters of the first picture, from ``(B, ...)`` to
        ``(...)``.
        """
        isp = self.isp.map(change)
        noise = {name: change(value) for name, value in self.noise.items()}
        extras = {name: change(value) for name, value in self.extras.items()}
        return AugmentParams(isp, noise, change(self.crop), extras)

    def camera(self) -> dict[str, Tensor]:
        """Say what a RAW file of this shot would, for networks that are conditioned on metadata, in the words of DNG.

        Returns:
            Tensors with a leading B if the parameters have one: ``AsShotNeutral`` ``(3,)``, the camera's colour of
            grey; ``white_balance`` ``(4,)``, the gains of R, Gr, Gb and B, green 1; ``camera_to_srgb`` ``(3, 3)``,
            white-balanced camera RGB to linear sRGB; ``BaselineExposure``, the stops by which the development
            brightens; ``NoiseProfile`` ``(2,)``, shot_var and read_var, if the noise has these; ``ISO``, if the noise
            is that of a camera by ISO; ``BlackLevel`` 0 and ``WhiteLevel`` 1.

        Example:
            >>> from rawaug import DictionaryISP, RawAugment
            >>> camera = RawAugment(DictionaryISP())(torch.rand(2, 3, 32, 32)).params.camera()
            >>> camera["white_balance"].shape, camera["camera_to_srgb"].shape
            (torch.Size([2, 4]), torch.Size([2, 3, 3]))
        """
        gains = self.isp.gains
        green = gains[..., 1]
        balance = gains / green[..., None]
        values = {
            "AsShotNeutral": 1.0 / balance,
            "white_balance": balance[..., [0, 1, 1, 2]],
            "camera_to_srgb": torch.linalg.inv(self.isp.matrix),
            "BaselineExposure": green.log2(),
            "BlackLevel": torch.zeros_like(green),
            "WhiteLevel": torch.ones_like(green),
        }
        if {"shot_var", "read_var"} <= self.noise.keys():
            values["NoiseProfile"] = torch.stack([self.noise["shot_var"], self.noise["read_var"]], dim=-1)
        if "iso" in self.noise:
            values["ISO"] = self.noise["iso"]
        return values

    def tensors(self) -> dict[str, Tensor]:
        """Return the parameters as a flat dict, to store with a batch; :meth:`from_tensors` reads it back."""
        flat = {}
        for group, tensors in (("isp", self.isp._asdict()), ("noise", self.noise), ("extras", self.extras)):
            for name, tensor in tensors.items():
                flat[f"{group}.{name}"] = tensor

        flat["crop"] = self.crop
        return flat

    @classmethod
    def concatenate(cls, parts: Sequence[AugmentParams]) -> AugmentParams:
        """Join the parameters of several batches ``(B, ...)`` to those of one."""
        if len(parts) == 1:
            return parts[0]
        first = parts[0]
        isp = ISPParams(*map(torch.cat, zip(*[params.isp for params in parts], strict=True)))
        noise = {name: torch.cat([params.noise[name] for params in parts]) for name in first.noise}
        extras = {name: torch.cat([params.extras[name] for params in parts]) for name in first.extras}
        return cls(isp, noise, torch.cat([params.crop for params in parts]), extras)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> AugmentParams:
        """Read the flat dict of :meth:`tensors`, ``(B, ...)`` or of one picture; ValueError if a tensor is missing."""
        setting = [f"isp.{name}" for name in ISPParams._fields]
        missing = sorted({"crop", *setting} - set(tensors))
        if missing:
            raise ValueError(f"not the parameters of an augmentation: {', '.join(missing)} missing")

        groups: dict[str, dict[str, Tensor]] = {"isp": {}, "noise": {}, "extras": {}}
        for name, tensor in tensors.items():
            group, _, key = name.partition(".")
            if group in groups:
                groups[group][key] = tensor

        isp = ISPParams(*[tensors[name] for name in setting])
        return cls(isp, groups["noise"], tensors["crop"], groups["extras"])


class RawPair(NamedTuple):
    """A training pair, packed R, Gr, Gb, B; it has no leading B if it comes from a Dataset.

    RAW of other patterns than Bayer's (:mod:`rawaug.bayer`) is ``(B, 1, H, W)`` in all three. Other targets and bursts
    have the shapes that :class:`rawaug.RawAugment` states.

    Args:
        noisy: ``(B, 4, H/2, W/2)``, at most 1, not clipped at 0.
        clean: ``(B, 4, H/2, W/2)``, at most 1, where the sensor saturates.
        variance: ``(B, 4, H/2, W/2)`` noise variance computed from the noisy signal, as a network sees it.
        params: parameters that reproduce the pair.
    """

    noisy: Tensor
    clean: Tensor
    variance: Tensor
    params: AugmentParams

    def map(self, change: Callable[[Tensor], Tensor]) -> RawPair:
        """Apply a function to every tensor; ``pair.map(lambda t: t[0])`` is the first pair of ``(B, 4, H/2, W/2)``."""
        return RawPair(change(self.noisy), change(self.clean), change(self.variance), self.params.map(change))

    @property
    def level(self) -> Tensor:
        """The strength of the noise, the root mean square of noisy minus clean: ``(B,)``, or a scalar.

        Networks for developed pictures take it as an input, on the scale white = 1.
        """
        if self.noisy.shape != self.clean.shape or self.noisy.numel() == 0:
            raise ValueError("level: noisy and clean differ in shape; a level is one of pairs of one kind")

        square = (self.noisy - self.clean).square()
        if self.params.crop.ndim == 1:
            return square.mean().sqrt()
        return square.flatten(1).mean(1).sqrt()


FIELDS = ("noisy", "clean", "variance", "params", "name", "level", "picture")
"""The fields of a sample: a pair's parts, the name of its picture, the strength of its noise, and the picture."""

RAW_PLANES = ("R", "Gr", "Gb", "B")
"""The planes of packed RAW, in order."""
_ORDERS = {"RGGB": (0, 1, 2, 3), "BGGR": (3, 2, 1, 0), "GRBG": (1, 0, 3, 2), "GBRG": (2, 3, 0, 1)}
"""The planes that ``pixel_unshuffle`` of a mosaic of each CFA gives, as indices into :data:`RAW_PLANES`."""


@dataclass(frozen=True)
class PairForm:
    """How a pair is handed over: whole, as a tuple or as a dict, and in which order its planes are.

    Args:
        fields: names from :data:`FIELDS`, in the order of the tuple or dict; None for a :class:`RawPair`.
        keys: a key for each field, for a dict.
        planes: indices of R, Gr, Gb and B in the order of the planes; None for this very order.
    """

    fields: tuple[str, ...] | None = None
    keys: tuple[str, ...] | None = None
    planes: tuple[int, ...] | None = None

    @property
    def reads_params(self) -> bool:
        """Whether the parameters of a pair are handed over, or looked at."""
        return self.fields is None or "params" in self.fields or "level" in self.fields

    def __call__(self, pair: RawPair, name: str | None = None, picture: Tensor | None = None) -> Any:
        """Hand over a pair, with or without B.

        Args:
            pair: packed RAW ``(..., 4, h, w)`` in the order R, Gr, Gb, B, or any other target.
            name: name of its picture.
            picture: ``(..., 3, H, W)``, the crop of the picture as it was cut and turned; 8 bits become [0, 1].

        Raises:
            ValueError: if the name is asked for and there is none.
        """
        if self.planes is not None:
            images = []
            for image in pair[:3]:
                if image.ndim >= 3 and image.shape[-3] == len(RAW_PLANES):  # packed; anything else stays as it is
                    image = image[..., list(self.planes), :, :]
                images.append(image)
            noisy, clean, variance = images
            pair = RawPair(noisy, clean, variance, pair.params)
        if self.fields is None:
            return pair

        values: list[Any] = []
        for field in self.fields:
            if field == "picture" and picture is not None:
                values.append(as_float(picture))
            elif field != "name":
                values.append(getattr(pair, field))
            elif name is not None:
                values.append(name)
            else:
                raise ValueError("keys: a loader of batches has no names of pictures; let its samples hold them")

        if self.keys is None:
            return tuple(values)
        return dict(zip(self.keys, values, strict=True))


Keys = Sequence[str] | Mapping[str, str]
"""Names for the parts of a pair, or names and the fields that they stand for."""


def pair_form(
    keys: Keys | None = None, fields: Sequence[str] | None = None, order: str | Sequence[str] | None = None
) -> PairForm:
    """Check how pairs are to be handed over.

    Args:
        keys: names for noisy, clean, variance and params, in this order, as many as are wanted; or a mapping of names
            to :data:`FIELDS`. The pair is then a dict.
        fields: names from :data:`FIELDS`, as many as are wanted; the pair is then a tuple of these.
        order: order of the planes of packed RAW: a CFA, for the order that ``pixel_unshuffle`` of such a mosaic gives;
            ``"RGBG"`` or the like, in which the first G is Gr; or four names of R, Gr, Gb, B.

    Raises:
        ValueError: if a name, a field or a plane is unknown or appears twice.
    """
    planes = None if order is None else parse_order(order)
    if keys is not None and fields is not None:
        raise ValueError("give keys for a dict, or fields for a tuple; keys={'lq': 'noisy'} names fields")

    if fields is not None:
        parts = () if isinstance(fields, str) else tuple(fields)
        if not parts or not set(parts) <= set(FIELDS):
            raise ValueError(f"fields are one or more of {', '.join(FIELDS)}, got {fields!r}")
        return PairForm(parts, None, planes)

    if isinstance(keys, Mapping):
        if not keys or not set(keys.values()) <= set(FIELDS):
            raise ValueError(f"keys are a mapping of names to {', '.join(FIELDS)}, got {dict(keys)!r}")
        return PairForm(tuple(keys.values()), tuple(keys), planes)

    if keys is None:
        return PairForm(planes=planes)

    names = () if isinstance(keys, str) else tuple(keys)
    if not 1 <= len(names) <= len(RawPair._fields) or len(set(names)) < len(names):
        listed = ", ".join(RawPair._fields)
        raise ValueError(f'keys are different names for {listed}, in this order, as ("noisy", "clean"); got {keys!r}')
    return PairForm(RawPair._fields[: len(names)], names, planes)


def parse_order(order: str | Sequence[str]) -> tuple[int, ...]:
    """Read an order of planes: indices of :data:`RAW_PLANES`; ValueError if it does not name each of them once."""
    if isinstance(order, str) and order in _ORDERS:
        return _ORDERS[order]

    names: list[str] = []
    for letter in order:
        if letter == "G":
            letter = "Gb" if "Gr" in names else "Gr"
        names.append(letter)

    if sorted(names) != sorted(RAW_PLANES):
        raise ValueError(f"order must be a CFA, RGBG or the like, or four of {', '.join(RAW_PLANES)}; got {order!r}")
    return tuple(RAW_PLANES.index(name) for name in names)


def save_params(params: AugmentParams, path: str | Path) -> None:
    """Write parameters to a safetensors file; an existing file is replaced as a whole."""
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
    contents = header.get("kind", "no rawaug parameters")
    if contents != _KIND:
        raise ValueError(f"{path}: holds {contents}, not the parameters of an augmentation")

    try:
        return AugmentParams.from_tensors(tensors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
