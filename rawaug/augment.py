r"""Online augmentation: sRGB pictures in, noisy/clean RAW pairs out.

``y = isp^-1(x; C, g)`` with the camera setting (C, g) drawn from the hull of the dictionaries' atoms, then
``noisy ~ N(y, shot_var y + read_var)``, clipped at white, never at black (Conde et al., AAAI 2022, "Dictionary
Augmentations").

:class:`RawAugment` works on batches, on the device of the batch; :class:`RawPairs` makes a Dataset of pairs from any
Dataset of pictures; :func:`wrap` makes a loader of pairs from any DataLoader. All draw their parameters first and apply
them after, and the parameters replay the pair bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from rawaug import bayer
from rawaug.conform import even_sided, to_rgb_tensor
from rawaug.isp.baked import BakedISP
from rawaug.isp.dictionary import convex_weights, perturb
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPParams
from rawaug.isp.stages import place_in_frame
from rawaug.noise import NoiseModel, noise_model
from rawaug.seeding import keyed_generator

Sampling = Literal["convex", "perturb", "chosen"]


class AugmentParams(NamedTuple):
    """All that was drawn for a batch; tensors with leading dimension B.

    Args:
        isp: camera settings.
        noise: levels and seeds of the noise.
        place: ``(B, 4)`` top, left, height, width: where in which full frame the picture stands.
    """

    isp: ISPParams
    noise: dict[str, Tensor]
    place: Tensor


class RawPair(NamedTuple):
    """A training pair, packed R, Gr, Gb, B; without the leading B where it comes from a Dataset.

    Args:
        noisy: ``(B, 4, H/2, W/2)``, at most 1, below 0 where the noise goes there.
        clean: ``(B, 4, H/2, W/2)``, at most 1: the sensor saturates there.
        variance: ``(B, 4, H/2, W/2)`` noise variance as the noisy signal tells it: what a network is given.
        params: replays the pair.
    """

    noisy: Tensor
    clean: Tensor
    variance: Tensor
    params: AugmentParams


class RawAugment(nn.Module):
    """sRGB batches to RAW pairs.

    Args:
        isp: the fitted camera.
        noise: name of a preset or a measured camera, (shot_var, read_var), a :class:`rawaug.noise.NoiseModel`, or
            ``"camera"`` for the levels that were measured when the ISP was fitted.
        sampling: ``"convex"`` draws uniform convex combinations of the atoms, without looking at the picture;
            ``"perturb"`` adds Gaussian noise to the weights that the ISP chooses; ``"chosen"`` takes these as they are.
        strength: of ``"perturb"``: standard deviation on the weights.
        seed: of the module's own draws, where no generator is passed.

    Example:
        >>> augment = RawAugment(DictionaryISP(), noise="cycleisp_sidd")
        >>> pair = augment(torch.rand(2, 3, 64, 64))
        >>> pair.noisy.shape
        torch.Size([2, 4, 32, 32])
        >>> torch.equal(pair.noisy, augment.apply(torch.zeros(2, 3, 64, 64), pair.params).noisy)
        False
    """

    def __init__(
        self,
        isp: DictionaryISP,
        noise: str | Sequence[float] | NoiseModel = "cycleisp_sidd",
        sampling: Sampling = "convex",
        strength: float = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if sampling not in ("convex", "perturb", "chosen"):
            raise ValueError(f"sampling {sampling!r} is none of convex, perturb, chosen")
        self.isp = isp.eval().requires_grad_(False)
        self.baked = BakedISP(self.isp)
        self.noise = noise_for(isp, noise)
        self.sampling = sampling
        self.strength = strength
        self.generator = keyed_generator(seed, "augment")

    @classmethod
    def from_pretrained(cls, isp: str | Path | DictionaryISP, **settings: Any) -> RawAugment:
        """From the name of a shipped ISP, a path, or an ISP; ``settings`` as in the constructor."""
        return cls(isp if isinstance(isp, DictionaryISP) else DictionaryISP.from_pretrained(isp), **settings)

    @torch.no_grad()
    def sample(
        self, srgb: Tensor, generator: torch.Generator | None = None, place: Tensor | None = None
    ) -> AugmentParams:
        """Draw parameters for a batch ``(B, 3, H, W)``.

        Args:
            srgb: the pictures; only ``perturb`` and ``chosen`` look at them, ``convex`` counts them.
            generator: on the CPU; the module's own by default.
            place: ``(B, 4)`` top, left, height, width of the pictures in their full frames; full frames by default.
        """
        generator = generator or self.generator
        batch, height, width = len(srgb), *srgb.shape[-2:]
        if place is None:
            place = torch.tensor([0, 0, height, width]).repeat(batch, 1)
        return AugmentParams(self._sample_isp(srgb, generator), self.noise.sample(batch, generator), place)

    def _sample_isp(self, srgb: Tensor, generator: torch.Generator) -> ISPParams:
        config, device = self.isp.config, srgb.device
        if self.sampling == "convex":
            colour, gain = (
                convex_weights(len(srgb), n, generator).to(device) for n in (config.colour_atoms, config.gain_atoms)
            )
        else:
            chosen = self.isp.choose(srgb)
            if self.sampling == "chosen":
                return chosen
            colour = perturb(chosen.colour_weights, self.strength, generator)
            gain = perturb(chosen.gain_weights, self.strength, generator)
        return self.isp.params_from_weights(colour, gain)

    @torch.no_grad()
    def apply(self, srgb: Any, params: AugmentParams | None = None) -> Any:
        """The pair that ``params`` describe: pure, bit for bit the same at every call.

        With a function alone it is ``nn.Module.apply``, which a surrounding module may call.

        Raises:
            ValueError: if the shape is not ``(B, 3, H, W)``, a side is odd, or ``params`` are for another batch size.
        """
        if params is None:
            return super().apply(srgb)
        clean = self.baked(srgb, params.isp, self._coordinates(srgb, params)).clamp_(max=1.0)
        noisy = self.noise.apply(clean, params.noise)
        return RawPair(noisy, clean, self.noise.variance(noisy, params.noise), params)

    def forward(self, srgb: Tensor, generator: torch.Generator | None = None) -> RawPair:
        """Sample, then apply: ``(B, 3, H, W)`` uint8 or float in [0, 1] to a :class:`RawPair`."""
        params = self.sample(srgb, generator)
        return self.apply(srgb, params)

    def _coordinates(self, srgb: Tensor, params: AugmentParams) -> Tensor | None:
        if "shading" not in self.isp.config.stages:
            return None
        places = {tuple(p) for p in params.place.tolist()}
        rows = params.place[:1] if len(places) == 1 else params.place
        height, width = srgb.shape[-2:]
        return torch.cat([place_in_frame(height, width, (t, left), (h, w)) for t, left, h, w in rows.tolist()])


def noise_for(isp: DictionaryISP, noise: str | Sequence[float] | NoiseModel) -> NoiseModel:
    """The noise model that ``noise`` means for this ISP: ``"camera"`` are the levels that stand in its file.

    Raises:
        ValueError: if none were measured, or the name is unknown.
    """
    if noise != "camera":
        return noise_model(noise)
    if "noise" not in isp.info:
        raise ValueError('noise "camera": this ISP was fitted without measuring noise; fit it again, or name a preset')
    return noise_model((isp.info["noise"]["shot_var"], isp.info["noise"]["read_var"]))


class _Sequence(Protocol):
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> Any: ...


class RawPairs(Dataset[Any]):
    """Any map-style Dataset of pictures as a Dataset of RAW pairs.

    A sample depends on (seed, epoch, index) alone: it is the same with any number of workers, any batch size, and after
    a resume. Its place in the frame is drawn as a crop, then one of eight flips and turns, then camera and noise.

    Args:
        dataset: yields pictures (tensor, NumPy array or PIL picture, HWC or CHW, uint8 or float in [0, 1], grey or RGBA
            too), tuples whose first element is the picture, or mappings that have it under ``key``. What else a
            sample holds is passed through.
        augment: makes the pair.
        crop: side of the square crop in pixels, even; None keeps whole pictures (made even by dropping a line).
        seed: of all draws.
        key: name of the picture in samples that are mappings.
        turns: whether to draw flips and quarter turns; whole pictures are only flipped.

    Raises:
        ValueError: if the crop is odd, or, on access, if a picture is smaller than the crop.
    """

    def __init__(
        self,
        dataset: _Sequence,
        augment: RawAugment,
        crop: int | None = 256,
        seed: int = 0,
        key: str | None = None,
        turns: bool = True,
    ) -> None:
        if crop is not None and (crop % 2 or crop < 2):
            raise ValueError(f"crop is even and at least 2, got {crop}")
        self.dataset, self.augment, self.crop, self.seed, self.key = dataset, augment, crop, seed, key
        self.turns = turns
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()  # persistent workers see it change

    def set_epoch(self, epoch: int) -> None:
        """Draw anew: call before each epoch."""
        self._epoch[0] = epoch

    def __len__(self) -> int:
        if not isinstance(self.dataset, Sized):
            raise TypeError("RawPairs needs a map-style Dataset with a length")
        return len(self.dataset)

    def __getitem__(self, index: int) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)  # ends iteration
        return self.draw(index, keyed_generator(self.seed, "pairs", int(self._epoch), index))

    def draw(self, index: int, generator: torch.Generator) -> Any:
        """The pair of picture ``index`` with all that is random taken from ``generator``."""
        sample = self.dataset[index]
        picture = to_rgb_tensor(picked(sample, self.key))
        patch, place = self._crop(picture, index, generator)
        params = self.augment.sample(patch[None], generator, place[None])
        pair = self.augment.apply(patch[None], params)
        return replaced(sample, self.key, without_batch(pair))

    def _crop(self, picture: Tensor, index: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        picture = even_sided(picture)
        height, width = picture.shape[-2:]
        side_y, side_x = (self.crop, self.crop) if self.crop else (height, width)
        if height < side_y or width < side_x:
            raise ValueError(
                f"picture {index} is {height} x {width}, smaller than the crop {side_y}; choose a smaller one"
            )
        top = 2 * int(torch.randint((height - side_y) // 2 + 1, (), generator=generator))
        left = 2 * int(torch.randint((width - side_x) // 2 + 1, (), generator=generator))
        patch = bayer.crop(picture, top, left, side_y, side_x)
        if self.turns:
            views = bayer.N_VIEWS if side_y == side_x else bayer.N_VIEWS // 2
            patch = bayer.turn(patch, int(torch.randint(views, (), generator=generator)))
        return patch.contiguous(), torch.tensor([top, left, height, width])


class WrappedLoader:
    """A DataLoader of RAW pairs, made by :func:`wrap`; its other attributes are the wrapped loader's own."""

    def __init__(
        self, loader: DataLoader[Any], augment: RawAugment, device: torch.device | str, key: str | None
    ) -> None:
        self.loader, self.device, self.key = loader, torch.device(device), key
        self.augment = augment.to(self.device)

    def __len__(self) -> int:
        return len(self.loader)

    def __iter__(self) -> Iterator[Any]:
        for batch in self.loader:
            srgb = torch.as_tensor(picked(batch, self.key)).to(self.device, non_blocking=True)
            yield replaced(batch, self.key, self.augment(even_sided(srgb)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.loader, name)


def wrap(
    loader: DataLoader[Any], augment: RawAugment, device: torch.device | str = "cpu", key: str | None = None
) -> WrappedLoader:
    """Any DataLoader of sRGB batches as a loader of RAW pairs; nothing else of the training script changes.

    Batches ``(B, 3, H, W)`` become a :class:`RawPair`; in tuples the first element and in mappings the one under
    ``key`` is replaced, all else passes. Pictures travel to ``device`` as they are (uint8 stays uint8).
    """
    return WrappedLoader(loader, augment, device, key)


def picked(sample: Any, key: str | None) -> Any:
    """The picture of a sample: under ``key``, the first of a tuple or list, or the sample itself."""
    if isinstance(sample, Mapping):
        if key not in sample:
            names = ", ".join(map(str, sample))
            raise ValueError(f"samples are mappings with the keys {names}; name the picture's with key=, got {key!r}")
        return sample[key]
    return sample[0] if isinstance(sample, (tuple, list)) else sample


def replaced(sample: Any, key: str | None, pair: RawPair) -> Any:
    """``sample`` with its picture replaced by ``pair``."""
    if isinstance(sample, Mapping):
        return {**sample, key: pair}
    if isinstance(sample, (tuple, list)):
        return (pair, *sample[1:])
    return pair


def without_batch(pair: RawPair) -> RawPair:
    """A batch of one as a sample: every tensor without its leading dimension."""
    isp = ISPParams(*(value[0] for value in pair.params.isp))
    noise = {name: value[0] for name, value in pair.params.noise.items()}
    return RawPair(pair.noisy[0], pair.clean[0], pair.variance[0], AugmentParams(isp, noise, pair.params.place[0]))
