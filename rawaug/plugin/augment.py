r"""Online augmentation: sRGB pictures in, noisy/clean RAW pairs out.

``y = isp^-1(x; C, g)`` with the camera setting (C, g) drawn from the hull of the dictionaries' atoms, then
``noisy ~ N(y, shot_var y + read_var)``, clipped at white, never at black (Conde et al., AAAI 2022, "Dictionary
Augmentations").

:class:`RawAugment` works on batches, on the device of the batch. It draws its parameters first and applies them after,
and the parameters replay the pair bit for bit. :mod:`rawaug.plugin.dataset` puts it behind a Dataset,
:mod:`rawaug.plugin.loader` behind a DataLoader.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, overload

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from rawaug.isp.dictionary import convex_weights, perturb
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams
from rawaug.isp.unbaked import reverse_pass
from rawaug.noise import NoiseModel, NoiseSpec, noise_model
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import even_sided, find_picture, is_picture, picked, replaced, to_rgb_batch
from rawaug.seeding import keyed_generator, rank_key

Sampling = Literal["convex", "perturb", "chosen"]


class RawAugment(nn.Module):
    """sRGB batches to RAW pairs.

    Args:
        isp: the fitted camera; is put in eval mode, without gradients.
        noise: name of a preset or a measured camera, (shot_var, read_var), a :class:`rawaug.noise.NoiseModel`, or
            ``"camera"`` for the levels that were measured when the ISP was fitted.
        sampling: ``"convex"`` draws uniform convex combinations of the atoms, without looking at the picture;
            ``"perturb"`` adds Gaussian noise to the weights that the ISP chooses; ``"chosen"`` takes these as they are.
        strength: of ``"perturb"``: standard deviation on the weights.
        seed: of the module's own draws, where no generator is passed. They are counted from its construction on: what
            is to go on where it stopped passes a generator, or takes RawPairs or wrap.
        exposure: lowest and highest exposure, in stops, that the RAW is drawn at, uniformly; ``(0, 0)`` is that of the
            camera which the ISP knows. Cameras differ in the headroom that they leave above their JPEG's white: for
            training that is to serve others, (-1.5, 0).

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
        noise: str | Sequence[float] | Sequence[str] | NoiseModel = "cycleisp_sidd",
        sampling: Sampling = "convex",
        strength: float = 0.1,
        seed: int = 0,
        exposure: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        super().__init__()
        if sampling not in ("convex", "perturb", "chosen"):
            raise ValueError(f"sampling {sampling!r} is none of convex, perturb, chosen")
        if not strength >= 0:
            raise ValueError(f"strength is a standard deviation, at least 0, got {strength}")
        if len(exposure) != 2 or not exposure[0] <= exposure[1]:
            raise ValueError(f"exposure is the lowest and the highest in stops, got {exposure}")
        self.isp = isp.eval().requires_grad_(False)
        self.baked = reverse_pass(self.isp)
        self.noise = noise_for(isp, noise)
        self.sampling = sampling
        self.strength = strength
        self.seed = seed
        self.exposure = exposure
        self._calls = 0

    @classmethod
    def from_pretrained(cls, isp: str | Path | DictionaryISP, **settings: Any) -> RawAugment:
        """From the name of a shipped ISP, a path, or an ISP; ``settings`` as in the constructor."""
        return cls(isp if isinstance(isp, DictionaryISP) else DictionaryISP.from_pretrained(isp), **settings)

    @torch.no_grad()
    def sample(self, srgb: Any, generator: torch.Generator | None = None, place: Tensor | None = None) -> AugmentParams:
        """Draw parameters for a batch; for a single picture without the leading B.

        Args:
            srgb: the pictures; only ``perturb`` and ``chosen`` look at them, ``convex`` counts them.
            generator: on the CPU; the module's own by default.
            place: ``(B, 5)`` top, left, height, width of the full frames, view; untouched full frames by default.
        """
        batch = self._batch(srgb)
        generator = generator or self._own_generator()
        if place is None:
            place = torch.tensor([0, 0, *batch.shape[-2:], 0]).repeat(len(batch), 1)
        with _float32(batch):
            setting = self._expose(self._sample_isp(batch, generator), generator)
            params = AugmentParams(setting, self.noise.sample(len(batch), generator), place)
        return params.map(lambda t: t[0]) if is_picture(srgb) else params

    def _sample_isp(self, srgb: Tensor, generator: torch.Generator) -> ISPParams:
        config, device = self.isp.config, srgb.device
        if self.sampling == "convex":
            colour, gain = (
                convex_weights(len(srgb), n, generator).to(device) for n in (config.colour_atoms, config.gain_atoms)
            )
        else:
            chosen = self.baked.choose(srgb)
            if self.sampling == "chosen":
                return chosen
            colour = perturb(chosen.colour_weights, self.strength, generator)
            gain = perturb(chosen.gain_weights, self.strength, generator)
        return self.isp.params_from_weights(colour, gain)

    def _expose(self, setting: ISPParams, generator: torch.Generator) -> ISPParams:
        """An exposure of e stops divides the gains of the forward direction by 2^e."""
        if not any(self.exposure):
            return setting
        low, high = self.exposure
        stops = low + (high - low) * torch.rand(len(setting.gains), 1, generator=generator)
        return setting._replace(gains=setting.gains * torch.exp2(-stops).to(setting.gains))

    @torch.no_grad()
    def apply(self, srgb: Any, params: AugmentParams | None = None) -> Any:
        """The :class:`RawPair` that ``params`` describe: pure, bit for bit the same at every call.

        For a single picture ``params`` and the pair have no leading B. With a function alone it is ``nn.Module.apply``,
        which a surrounding module may call.

        Raises:
            ValueError: if ``srgb`` is no batch of pictures, or ``params`` are for another number of them.
        """
        if params is None:
            return super().apply(srgb)
        if is_picture(srgb):
            return self._pair(self._batch(srgb), params.map(lambda t: t[None])).map(lambda t: t[0])
        return self._pair(self._batch(srgb), params)

    def _pair(self, srgb: Tensor, params: AugmentParams) -> RawPair:
        if len(params.place) != len(srgb):
            raise ValueError(f"the parameters are those of {len(params.place)} pictures, the batch has {len(srgb)}")
        with _float32(srgb):
            clean = self.baked(srgb, params.isp, params.place, white=1.0)
            noisy, variance = self.noise.apply_with_variance(clean, params.noise)
            return RawPair(noisy, clean, variance, params)

    @overload
    def forward(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
    @overload
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any: ...
    @torch.no_grad()
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any:
        """Sample, then apply.

        Args:
            batch: pictures ``(B, 3, H, W)`` in any form that :mod:`rawaug.plugin.pictures` lists, or a tuple or mapping
                that has them. A single picture makes a single pair, without the leading B.
            generator: of all that is drawn, on the CPU; the module's own by default.
            key: name or index of the pictures in a mapping or tuple.

        Returns:
            A :class:`RawPair`; of a tuple or mapping, this with the pair in place of the pictures.

        Raises:
            ValueError: if there is no picture.
        """
        where = find_picture(batch, key, batched=True)
        pictures = picked(batch, where)
        srgb = self._batch(pictures)
        pair = self._pair(srgb, self.sample(srgb, generator))
        return replaced(batch, where, pair.map(lambda t: t[0]) if is_picture(pictures) else pair)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RawAugment:
        """Go where the surrounding network goes, but stay float32, in a network of bfloat16 too."""

        def moved(tensor: Tensor) -> Tensor:
            probe = fn(tensor.new_empty(0))
            return fn(tensor) if probe.dtype == tensor.dtype else tensor.to(probe.device)

        return super()._apply(moved, recurse)

    @property
    def device(self) -> torch.device:
        """Where the module is."""
        return next(self.isp.parameters()).device

    def _batch(self, pictures: Any) -> Tensor:
        """``(B, 3, H, W)`` with even sides; what is no tensor yet goes to the module's device."""
        device = self.device
        srgb = even_sided(to_rgb_batch(pictures))
        if not isinstance(pictures, Tensor):
            return srgb.to(device)
        if srgb.device != device:
            raise ValueError(f"the pictures are on {srgb.device}, the augmentation on {device}; call augment.to(...)")
        return srgb

    def _own_generator(self) -> torch.Generator:
        """A new one for each call; by worker and process too, or all of them would draw the same."""
        self._calls += 1
        worker = get_worker_info()
        return keyed_generator(self.seed, "augment", worker.seed if worker else 0, self._calls, *rank_key())


def _float32(like: Tensor) -> torch.autocast:
    """RAW is float32, inside mixed precision too."""
    return torch.autocast(like.device.type, enabled=False)


def noise_for(isp: DictionaryISP, noise: NoiseSpec | NoiseModel) -> NoiseModel:
    """The noise model that ``noise`` means for this ISP: ``"camera"`` are the levels that stand in its file.

    Raises:
        ValueError: if none were measured, or the name is unknown.
    """
    if noise != "camera":
        return noise_model(noise)
    if "noise" not in isp.info:
        raise ValueError('noise "camera": this ISP was fitted without measuring noise; fit it again, or name a preset')
    return noise_model((isp.info["noise"]["shot_var"], isp.info["noise"]["read_var"]))
