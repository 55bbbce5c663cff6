r"""The base of every network: ``denoised = noisy + residual([noisy, noise map])``.

Domain: packed RAW in float, white = 1, not clipped at black, of any height and width from 2 on. A network that pools
``s`` times needs sides that are multiples of its ``stride = 2^s``: the picture is padded below and on the right by
reflection without repeating the edge (as often as needed, so that even a 2 x 2 picture passes), and the result is
cropped back. With ``pyramid`` it also denoises at half the sides (:mod:`denoisers.pyramid`).

The noise map is the standard deviation by default. UPI's is the variance, whose values of 1e-5 to 1e-2 move the first
layer little: after 400 steps at a learning rate of 1e-3, the U-Net of width 8 had taken 12 % off the l1 error with the
deviation and 6 % with the variance. The residual's last convolution starts at zero, so that an untrained network is the
identity.
"""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypedDict, Unpack

import numpy as np
import torch
from torch import Tensor, nn

from denoisers.defects import mend_planes
from denoisers.domains import DOMAINS, Levels, fit_levels
from denoisers.layers import HE_GAIN, MOST_FEATURES, pad_to_multiple
from denoisers.layers import PACKED as PACKED
from denoisers.layers import conv as conv
from denoisers.pyramid import MOST_HALVINGS, double, halve, halved_variance, smooth_correction
from rawaug.registry import Registry, require_between

DENOISERS = Registry("denoiser", "rawaug.denoisers", "denoisers")
"""This maps names to networks, which are subclasses of :class:`Denoiser`."""

NEAR = 8.0
"""A network sees its limits up to this distance, in standard deviations of the noise."""


class Shared(TypedDict, total=False):
    """The settings that every network takes besides its own; :class:`Denoiser` explains them."""

    channels: int
    variance_map: bool
    deviation: bool
    domain: str
    seed: int


class Denoiser(nn.Module, ABC):
    """Base of the networks: ``model(noisy, variance=None) -> denoised``, all ``(B, channels, h, w)``, white = 1.

    A network's constructor takes its own settings and ``**shared``, and hands the latter on.

    Args:
        config: the network's own settings. They are kept with the weights as :attr:`config`, together with the shared
            settings that its constructor takes, except the seed, so that the same network can be built again.
        stride: the sides of a picture are padded to multiples of this internally.
        limits: feed, as two times ``channels`` more inputs, how far the transformed signal is above 0 and below white,
            at most :data:`NEAR`: it shows where photons are few, and where the sensor clips. Not available in the
            domain ``linear``.
        mend: replace hot and dead pixels of packed RAW before the network (:func:`denoisers.defects.mend_planes`). Not
            available in the domain ``linear``.
        pyramid: how many times, 0 to 4, the sides are halved to denoise there too, where wide noise is narrow, and to
            take what is wide from there; it is a quarter to a third more work. Not available if the result is
            demosaiced.
        channels: channels of the picture, 1 to 65536; by default 4, which is packed RAW.
        variance_map: feed the noise map as ``channels`` more inputs; calls must then pass ``variance``.
        deviation: feed the standard deviation, sqrt(variance), instead of the variance; it matters only with a noise
            map.
        domain: ``linear``, or a transform of :mod:`denoisers.domains`; calls must then pass ``variance``, a map
            ``shot_var max(noisy, 0) + read_var``.
        seed: seed of the initial weights.

    Raises:
        TypeError: if there is no such setting.
        ValueError: if there is no such domain, it does not go with the rest, or a number is out of range.
    """

    defaults: ClassVar[Shared] = Shared(channels=PACKED, variance_map=True, deviation=True, domain="linear", seed=0)
    """The shared settings have these values if a call leaves them out."""
    __signature__: ClassVar[inspect.Signature]

    mixed: ClassVar[bool] = False
    """This says whether bfloat16 costs the network less than 0.05 dB and speeds up dense convolutions."""
    growing: ClassVar[frozenset[str]] = frozenset()
    """These settings may be larger than those of the network whose weights a training starts from."""
    layerless: ClassVar[frozenset[str]] = frozenset()
    """No layer depends on these settings, so a training may start from weights that have others."""
    views: int = 1
    """This many turned views of a developed picture, 1, 2, 4 or 8, are averaged if nothing else is asked for."""
    upscale: ClassVar[int] = 1
    """The result's sides are this many times those of packed RAW: 2 if it is demosaiced, ``(B, 3, 2h, 2w)``."""

    def __init_subclass__(cls) -> None:
        """Show ``help`` and recipes the shared settings by name, instead of ``**shared``."""
        declared = inspect.signature(cls.__init__).parameters
        parameters = []
        for name, parameter in declared.items():
            if name not in ("self", "shared"):
                parameters.append(parameter)

        if "shared" in declared:
            keyword = inspect.Parameter.KEYWORD_ONLY
            for name, default in cls.defaults.items():
                annotation = type(default).__name__
                parameters.append(inspect.Parameter(name, keyword, default=default, annotation=annotation))
        cls.__signature__ = inspect.Signature(parameters)

    def __init__(
        self,
        config: dict[str, Any],
        stride: int = 1,
        limits: bool = False,
        mend: bool = False,
        pyramid: int = 0,
        **shared: Unpack[Shared],
    ) -> None:
        super().__init__()
        unknown = shared.keys() - Denoiser.defaults.keys()
        if unknown:
            raise TypeError(f"{type(self).__name__} has no setting {min(unknown)!r}")

        settings: Shared = {**self.defaults, **shared}
        self.channels = settings["channels"]
        self.variance_map = settings["variance_map"]
        self.deviation = settings["deviation"]
        self.domain = settings["domain"]
        self.seed = settings["seed"]

        if (limits or mend) and self.domain == "linear":
            raise ValueError("limits and mend need a transformed signal; choose domain ksigma or anscombe")
        if mend and self.channels != PACKED:
            raise ValueError(f"mend compares the planes of packed RAW, {PACKED} channels, got {self.channels}")
        if self.domain != "linear" and self.domain not in DOMAINS:
            raise ValueError(f"domain {self.domain!r} is unknown; use one of linear, {', '.join(DOMAINS)}")
        require_between("channels", self.channels, 1, MOST_FEATURES)
        require_between("seed", self.seed, -(2**63), 2**63 - 1)
        require_between("pyramid", pyramid, 0, MOST_HALVINGS)

        self.limits = limits
        self.mend = mend
        self.pyramid = pyramid
        self.multiple = stride
        self.stride = stride << pyramid
        self.config = {**config, **self._shared_config(settings)}

    def _shared_config(self, settings: Shared) -> dict[str, Any]:
        """Select the shared settings that build the same network again: those of its constructor, except the seed."""
        parameters = type(self).__signature__.parameters
        takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())

        config: dict[str, Any] = {}
        for key, value in settings.items():
            if key != "seed" and (key in parameters or takes_any):
                config[key] = value

        default_domain = self.defaults["domain"]
        if "domain" in parameters:
            default_domain = parameters["domain"].default
        if config.get("domain") == default_domain == "linear":
            del config["domain"]
        return config

    @property
    def inputs(self) -> int:
        """Channels that enter the first layer."""
        return self.channels * (1 + self.variance_map + 2 * self.limits)

    @property
    def reads_variance(self) -> bool:
        """Whether calls must pass the noise variance."""
        return self.variance_map or self.domain != "linear"

    @abstractmethod
    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``.

        The sides are multiples of ``stride``. A network with :attr:`upscale` 2 returns the correction of its result.
        """

    def base_image(self, packed: Tensor) -> Tensor:
        """Return what the correction is added to: the picture ``(B, channels, h, w)``, unless the result is larger."""
        return packed

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, channels, h, w)``; the result has the same shape, or :attr:`upscale`'s, and is not clipped.

        ``variance``, the noise variance of each value, has the shape of ``noisy``. ValueError is raised if a shape or
        type is wrong, or the network needs ``variance`` and it is missing.
        """
        variance = self._require_input(noisy, variance)

        mended = noisy
        if variance is not None and self.mend:
            levels = fit_levels(noisy.float(), variance.float())
            mended = self._mend(noisy, levels, mend_planes)

        clipped = (mended >= 1.0).to(noisy.dtype)
        denoised = self._at_scales(mended, variance, clipped, self.pyramid)

        if variance is None or self.domain == "linear" or self.upscale > 1:
            return denoised
        return torch.where(variance > 0, denoised, noisy)

    def _at_scales(self, noisy: Tensor, variance: Tensor | None, clipped: Tensor, halvings: int) -> Tensor:
        """Run the recursion ``g(y) = f(y) + U k(g(B y) - B f(y))``; ``clipped`` is the share of clipped values."""
        denoised = self._at_one_scale(noisy, variance)
        if not halvings:
            return denoised

        half_noisy = halve(pad_to_multiple(noisy, 4))
        half_denoised = halve(pad_to_multiple(denoised, 4))
        half_clipped = halve(pad_to_multiple(clipped, 4))
        half_variance = None
        if variance is not None:
            half_variance = halved_variance(pad_to_multiple(variance, 4))

        coarse = self._at_scales(half_noisy, half_variance, half_clipped, halvings - 1)
        correction = double(smooth_correction(coarse - half_denoised, half_clipped))

        height, width = noisy.shape[-2:]
        return denoised + correction[..., :height, :width]

    def _at_one_scale(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
        """Denoise without the pyramid, f: transform a picture, add the network's correction, and transform it back."""
        if variance is None or not self.reads_variance:
            return self.base_image(noisy) + self._correction(noisy)

        if self.domain == "linear":
            noise_map = variance.sqrt() if self.deviation else variance
            return self.base_image(noisy) + self._correction(noisy, noise_map)

        domain = DOMAINS[self.domain]
        levels = fit_levels(noisy.float(), variance.float())
        signal = domain.forward(noisy.float(), *levels)
        distances = self.distances(signal, levels)

        if self.variance_map:
            deviation = domain.relative_deviation(noisy.float(), variance.float(), *levels)
            correction = deviation * self._correction(signal, deviation, *distances)
        else:
            correction = self._correction(signal, *distances)

        denoised = domain.inverse(self.base_image(signal) + correction, *levels)
        return denoised.to(noisy.dtype)

    def distances(self, signal: Tensor, levels: Levels) -> list[Tensor]:
        """Compute the distances of a signal from black and white, up to :data:`NEAR`, if the network takes them."""
        if not self.limits:
            return []
        white = DOMAINS[self.domain].forward(torch.ones_like(levels[0]), *levels)
        return [signal.clamp_max(NEAR), (white - signal).clamp_max(NEAR)]

    def _correction(self, signal: Tensor, *maps: Tensor) -> Tensor:
        """Compute the residual of a signal and its maps; pad to what the network takes, and crop back."""
        features = signal
        if maps:
            features = torch.cat([signal, *maps], dim=1)

        correction = self.residual(pad_to_multiple(features.to(self._dtype), self.multiple))
        height, width = signal.shape[-2:]
        return correction[..., : self.upscale * height, : self.upscale * width]

    def _mend(self, noisy: Tensor, levels: Levels, mend: Callable[[Tensor], Tensor]) -> Tensor:
        """Replace the defects that ``mend`` replaces in the transformed signal; all other values keep their bits."""
        domain = DOMAINS[self.domain]
        signal = domain.forward(noisy.float(), *levels)
        mended = mend(signal)
        replacement = domain.inverse(mended, *levels).to(noisy.dtype)
        return torch.where(mended == signal, noisy, replacement)

    @property
    def _dtype(self) -> torch.dtype:
        parameter = next(self.parameters(), None)
        if parameter is None:
            return torch.get_default_dtype()
        return parameter.dtype

    def _require_input(self, noisy: Tensor, variance: Tensor | None) -> Tensor | None:
        """Return the noise map; raise ValueError if the picture or a map that the network reads is wrong."""
        if noisy.ndim != 4 or noisy.shape[1] != self.channels or min(noisy.shape[-2:]) < 2:
            name = type(self).__name__
            raise ValueError(f"{name} takes (B, {self.channels}, h >= 2, w >= 2), got {tuple(noisy.shape)}")
        self._require_type(noisy, "noisy")

        if self.reads_variance:
            return self._require_variance(noisy, variance)
        return variance

    def _require_type(self, image: Tensor, name: str) -> None:
        """Raise ValueError unless an image has the type of the weights; mixed precision converts by itself."""
        if not image.is_floating_point():
            raise ValueError(f"{name} must be floating-point RAW with white at 1, got {image.dtype}")
        if image.dtype != self._dtype and not torch.is_autocast_enabled(image.device.type):
            raise ValueError(f"{name} is {image.dtype} but the network is {self._dtype}; convert one of them")

    def _require_variance(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
        """Return the noise map; raise ValueError if it is missing, negative, or of another shape or type."""
        if variance is None:
            reason = f"domain={self.domain!r}"
            if self.variance_map:
                reason = "variance_map=True"
            raise ValueError(f"{type(self).__name__} was built with {reason}: pass the noise variance of each value")
        if variance.shape != noisy.shape:
            raise ValueError(f"variance {tuple(variance.shape)} must have the shape {tuple(noisy.shape)} of noisy")
        self._require_type(variance, "variance")

        is_traced = torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export()
        is_on_cpu = variance.device.type == "cpu"  # on other devices, reading a value back would stall
        if is_on_cpu and not is_traced and variance.numel() and float(variance.detach().min()) < 0.0:
            raise ValueError(f"variance must not be negative, got {float(variance.min()):.3g}")
        return variance

    def is_relative(self, model: Denoiser) -> bool:
        """Tell whether a network is of this class or of one of its bases, so that its layers are layers of this one."""
        return isinstance(self, type(model))

    def can_start_from(self, model: Denoiser) -> bool:
        """Tell whether :meth:`start_from` can take a network's weights: its class and its settings fit this one's."""
        if not self.is_relative(model):
            return False

        for key in (self.config.keys() & model.config.keys()) - self.layerless:
            mine = self.config[key]
            other = model.config[key]
            grows = key in self.growing and _is_as_large(mine, other)
            if mine != other and not grows:
                return False
        return True

    @property
    def core(self) -> Denoiser:
        """The network whose weights a network of another kind starts from: this one, unless it is made of several."""
        return self

    def start_from(self, model: Denoiser) -> None:
        """Take the weights of a network that this one can start from; layers beyond those stay as they are."""
        is_complete = type(self) is type(model) and self.config == model.config
        self.load_state_dict(model.state_dict(), strict=is_complete)

    @torch.no_grad()
    def initialise(self, seed: int, *zeros: nn.Conv2d, gain: float = HE_GAIN) -> None:
        """Draw convolutions anew (He et al. 2015), deviation ``gain / sqrt(fan in)``; set biases and ``zeros`` to zero.

        The numbers come from a CPU generator of ``seed``, so they are the same on every device, and the global state is
        untouched. They are drawn in the order in which the layers were added.
        """
        generator = torch.Generator("cpu").manual_seed(seed)
        for module in self.modules():
            if not isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)) or module.weight.is_meta:
                continue

            if module.bias is not None:
                module.bias.zero_()
            if module in zeros:
                module.weight.zero_()
                continue

            fan_in = math.prod(module.weight.shape[1:])
            if isinstance(module, nn.ConvTranspose2d):
                # Transposed convolutions here have as many taps as strides, so each output has one tap.
                fan_in = module.in_channels
            weight = torch.empty(module.weight.shape, device="cpu")
            nn.init.normal_(weight, 0.0, gain / math.sqrt(fan_in), generator=generator)
            module.weight.copy_(weight)


def _is_as_large(value: int | Sequence[int], other: int | Sequence[int]) -> bool:
    """Tell whether a setting, one number or one for each scale, is nowhere smaller than another."""
    values = np.atleast_1d(value)
    second_values = np.atleast_1d(other)
    can_compare = 1 in (len(values), len(second_values)) or len(values) == len(second_values)
    return can_compare and bool((values >= second_values).all())
