r"""The base of every network: ``denoised = noisy + residual([noisy, noise map])``.

Domain: packed RAW, float, white = 1, not clipped at black; any height and width from 2 on. A network that pools ``s``
times needs sides that are multiples of its ``stride = 2^s``: the picture is padded below and on the right by reflection
without repeating the edge (as often as needed, so a 2 x 2 picture passes too), and the result is cropped back.

With ``pyramid`` the result of one scale, f, is corrected by what is found at half the sides, where wide
noise is narrow:
``g_n(y) = f(y) + U k(g_{n-1}(B y) - B f(y))`` and ``g_0 = f``, B binning by 2 and U interpolating. k is 1, and falls
to 0 where :data:`BLIND` of the values are clipped: their mean does not tell the light.

The noise map is the standard deviation by default. UPI's is the variance, whose values of 1e-5 to 1e-2 move the first
layer little: after 400 steps at a learning rate of 1e-3 the U-Net of width 8 had taken 12 % off the l1 error with the
deviation and 6 % with the variance. The residual's last convolution starts at zero, so that an untrained network is the
identity.
"""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import reduce
from typing import Any, ClassVar, TypedDict, Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.domains import DOMAINS, fit_levels
from rawaug import bayer
from rawaug.registry import Registry, require_between

DENOISERS = Registry("denoiser", "rawaug.denoisers", "denoisers")
"""The networks by name: subclasses of :class:`Denoiser`."""

PACKED = 4
"""Channels of packed RAW: R, Gr, Gb, B."""

MOST_FEATURES, MOST_LAYERS, MOST_SCALES = 2**16, 1000, 12
"""Limits of a network's size, as a few bytes of a file or a recipe can ask for any."""

MOST_HALVINGS = 4
BLIND = 0.25
"""Minimum share of clipped values for ignoring the picture at half the sides."""

NEAR = 8.0
"""The distance up to which a network sees its limits, in standard deviations of the noise."""

DEFECT = (5.0, 0.15)
"""Thresholds of a defect beyond its neighbours: in deviations of the noise, and as a share of their value."""

LEAK = 0.2
"""Negative slope of the leaky ReLUs."""
HE_GAIN = math.sqrt(2.0 / (1.0 + LEAK**2))
"""Keeps the deviation of features through a convolution and its leaky ReLU."""
RESIDUAL_GAIN = math.sqrt(1.0 / 3.0)
"""Gain of networks that add up dozens of residuals of separable convolutions, which HE_GAIN would let grow."""


def conv(
    inputs: int,
    outputs: int,
    size: int = 3,
    bias: bool = True,
    stride: int = 1,
    groups: int = 1,
    padding: int | None = None,
) -> nn.Conv2d:
    """A convolution that keeps the sides of a picture or divides them by ``stride``.

    Its weights are left as they are in memory; :meth:`Denoiser.initialise` draws those of the whole network.

    Args:
        inputs: channels that come in, a multiple of ``groups``.
        outputs: channels that go out.
        size: side of the square kernel.
        bias: whether the layer adds a constant to each channel.
        stride: step from one output pixel to the next.
        groups: parts of the channels that do not see each other; as many as there are inputs for a depthwise layer.
        padding: zeros around the picture, half of ``size`` by default.
    """
    settings = {"stride": stride, "groups": groups, "padding": size // 2 if padding is None else padding, "bias": bias}
    return nn.utils.skip_init(nn.Conv2d, inputs, outputs, size, device=torch.get_default_device(), **settings)


def pad_to_multiple(image: Tensor, stride: int) -> Tensor:
    """Pad ``(B, C, h, w)`` below and on the right to multiples of ``stride``, by reflection without the edge."""
    for axis in (-2, -1):
        size = image.shape[axis]
        padding = -size % stride
        if torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export() or padding:  # exported, it pads any size
            period = 2 * (size - 1)
            place = torch.remainder(torch.arange(size + padding, device=image.device), period)
            image = image.index_select(axis, torch.minimum(place, period - place))
    return image


def require_width(width: int, multiple: int = 1) -> None:
    """Refuse a number of features that no layer can have, or that no machine could hold."""
    if width < 1 or width % multiple:
        raise ValueError(f"width must be a positive multiple of {multiple}, got {width}")
    require_between("width", width, 1, MOST_FEATURES)


def require_bounded(**layers: int) -> None:
    """Refuse more layers than :data:`MOST_LAYERS`, which no machine would build; each by the name of its setting."""
    for key, number in layers.items():
        require_between(key, number, 0, MOST_LAYERS)


def mend_planes(signal: Tensor) -> Tensor:
    """Replace the hot and dead pixels of packed RAW ``(B, 4, h, w)``, whose noise has deviation 1.

    A pixel is a defect if it lies beyond all eight neighbours of its colour by :data:`DEFECT` while the other colours
    of its cell follow theirs. It becomes the mean of its neighbours without their lowest and highest.
    """
    height, width = signal.shape[-2:]
    padded = F.pad(signal, (1, 1, 1, 1), mode="reflect")
    places = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    near = [padded[..., i : i + height, j : j + width] for i, j in places]
    low, high = reduce(torch.minimum, near), reduce(torch.maximum, near)
    mean = (reduce(torch.add, near) - low - high) / (len(places) - 2)
    deviations, share = DEFECT
    beyond = (signal > high + share * high.abs() + deviations) | (signal < low - share * low.abs() - deviations)
    departure = (signal - mean).abs()
    # An edge or a small light moves several colours of a cell at once, a defect one alone.
    alone = departure > 4.0 * departure.topk(2, dim=1).values[:, 1:]
    return torch.where(beyond & alone, mean, signal)


def halve(picture: Tensor) -> Tensor:
    """Average a picture ``(B, C, h, w)``, sides even, to half its sides, ``(B, C, h/2, w/2)``.

    Packed RAW, whose sites are those of RGGB, is binned around the places of the new sites.
    """
    if picture.shape[1] != PACKED:
        return F.avg_pool2d(picture, 2)
    return bayer.bin_packed(picture, 2)


def double(picture: Tensor) -> Tensor:
    """Interpolate a picture ``(B, C, h, w)`` linearly to twice its sides, ``(B, C, 2h, 2w)``.

    The sites of packed RAW are where :func:`halve` puts them.
    """
    if picture.shape[1] != PACKED:
        return F.interpolate(picture, scale_factor=2, mode="bilinear")
    taps = torch.tensor([[3.0, 7, 5, 1], [1, 5, 7, 3]], device=picture.device) / 8  # of the first and second site
    kernels = torch.stack([torch.outer(taps[i], taps[j]) for i, j in bayer.CFA.RGGB.sites])[:, None]
    padded = F.pad(picture, (1, 1, 1, 1), mode="replicate")
    return F.conv_transpose2d(padded, kernels.to(picture.dtype), stride=2, padding=3, groups=PACKED)


def smooth_correction(difference: Tensor, clipped: Tensor) -> Tensor:
    """Smooth what a picture at half the sides corrects, ``(B, C, h, w)``, and fade it out where values are clipped.

    ``clipped`` is the share of clipped values, of the same shape. Near its own limit of resolution the half picture
    knows less than the whole one.
    """
    wide, near = (F.avg_pool2d(x, 3, 1, 1, count_include_pad=False) for x in (difference, clipped))
    return (1.0 - near / BLIND).clamp_min(0.0) * wide


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
        config: the network's own settings, kept with the weights so that the same network can be built again.
        stride: inside, the sides of a picture are padded to multiples of this.
        limits: feed, as two times ``channels`` more inputs, how far the transformed signal is above 0 and below white,
            at most :data:`NEAR`: where photons are few, and where the sensor clips. Not in the domain ``linear``.
        mend: put :func:`mend_planes` before the network, of packed RAW. Not in the domain ``linear``.
        pyramid: times, 0 to 4, that the sides are halved to denoise there too, where wide noise is narrow, and to take
            what is wide from there; a quarter to a third more work. Not where the result is demosaiced.
        channels: of the picture, 1 to 65536; 4, packed RAW, by default.
        variance_map: feed the noise map as ``channels`` more inputs; calls must then pass ``variance``.
        deviation: feed the standard deviation, sqrt(variance), in place of the variance; matters to a noise map only.
        domain: ``linear``, or a transform of :mod:`denoisers.domains`; calls must then pass ``variance``, a map
            ``shot_var max(noisy, 0) + read_var``.
        seed: the network draws its first weights from it.

    Raises:
        TypeError: if there is no such setting.
        ValueError: if there is no such domain, it does not go with the rest, or a number is out of range.
    """

    defaults: ClassVar[Shared] = Shared(channels=PACKED, variance_map=True, deviation=True, domain="linear", seed=0)
    """The shared settings where a call leaves them out."""
    __signature__: ClassVar[inspect.Signature]

    mixed: ClassVar[bool] = False
    """Whether bfloat16 costs it less than 0.05 dB, and dense convolutions gain by it."""
    growing: ClassVar[frozenset[str]] = frozenset()
    """Settings that may be larger than those of the network whose weights a training starts from."""
    upscale: ClassVar[int] = 1
    """Sides of the result over those of packed RAW: 2 where it is demosaiced, ``(B, 3, 2h, 2w)``."""

    def __init_subclass__(cls) -> None:
        """Let ``help`` and recipes see the shared settings by name, in place of ``**shared``."""
        own = inspect.signature(cls.__init__).parameters
        shown = [parameter for name, parameter in own.items() if name not in ("self", "shared")]
        for name, value in cls.defaults.items() if "shared" in own else ():
            keyword = inspect.Parameter.KEYWORD_ONLY
            shown.append(inspect.Parameter(name, keyword, default=value, annotation=type(value).__name__))
        cls.__signature__ = inspect.Signature(shown)

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
        if unknown := shared.keys() - Denoiser.defaults.keys():
            raise TypeError(f"{type(self).__name__} has no setting {min(unknown)!r}")
        settings: Shared = {**self.defaults, **shared}
        channels, domain, self.seed = settings["channels"], settings["domain"], settings["seed"]
        if (limits or mend) and domain == "linear":
            raise ValueError("limits and mend need a transformed signal; choose domain ksigma or anscombe")
        if mend and channels != PACKED:
            raise ValueError(f"mend compares the planes of packed RAW, {PACKED} channels, got {channels}")
        if domain != "linear" and domain not in DOMAINS:
            raise ValueError(f"domain {domain!r} is unknown; use one of linear, {', '.join(DOMAINS)}")
        require_between("channels", channels, 1, MOST_FEATURES)
        require_between("seed", self.seed, -(2**63), 2**63 - 1)
        require_between("pyramid", pyramid, 0, MOST_HALVINGS)
        self.domain, self.limits, self.mend, self.pyramid = domain, limits, mend, pyramid
        self.channels = channels
        self.variance_map, self.deviation = settings["variance_map"], settings["deviation"]
        self.multiple, self.stride = stride, stride << pyramid
        self.config = {**config, **{key: value for key, value in settings.items() if key not in ("domain", "seed")}}
        self.config |= {} if domain == "linear" else {"domain": domain}

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

        The sides are multiples of ``stride``. A network with :attr:`upscale` 2 gives the correction of its result.
        """

    def base_image(self, packed: Tensor) -> Tensor:
        """The picture that the correction is added to: ``(B, channels, h, w)`` itself, unless the result is larger."""
        return packed

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, channels, h, w)``; the result has the same shape, or :attr:`upscale`'s, and is not clipped.

        ``variance``, the noise variance of each value, has the shape of ``noisy``. ValueError if a shape or type is
        wrong, or the network needs ``variance`` and it is missing.
        """
        name = type(self).__name__
        if noisy.ndim != 4 or noisy.shape[1] != self.channels or min(noisy.shape[-2:]) < 2:
            raise ValueError(f"{name} takes (B, {self.channels}, h >= 2, w >= 2), got {tuple(noisy.shape)}")
        self._require_type(noisy, "noisy")
        if self.reads_variance:
            variance = self._require_variance(noisy, variance)
        whole = noisy
        if variance is not None and self.mend:
            whole = self._mend(noisy, fit_levels(noisy.float(), variance.float()), mend_planes)
        denoised = self._at_scales(whole, variance, (whole >= 1.0).to(noisy.dtype), self.pyramid)
        if variance is None or self.domain == "linear" or self.upscale > 1:
            return denoised
        return torch.where(variance > 0, denoised, noisy)

    def _require_variance(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
        name = type(self).__name__
        if variance is None:
            needed = "variance_map=True" if self.variance_map else f"domain={self.domain!r}"
            raise ValueError(f"{name} was built with {needed}: pass the noise variance of each value")
        if variance.shape != noisy.shape:
            raise ValueError(f"variance {tuple(variance.shape)} must have the shape {tuple(noisy.shape)} of noisy")
        self._require_type(variance, "variance")
        traced = torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export()
        on_cpu = variance.device.type == "cpu"  # elsewhere reading a value back would stall the device
        if on_cpu and not traced and variance.numel() and float(variance.detach().min()) < 0.0:
            raise ValueError(f"variance must not be negative, got {float(variance.min()):.3g}")
        return variance

    def _at_one_scale(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
        if variance is None or not self.reads_variance:
            return self.base_image(noisy) + self._correction(noisy)
        if self.domain == "linear":
            correction = self._correction(noisy, variance.sqrt() if self.deviation else variance)
            return self.base_image(noisy) + correction
        domain, levels = DOMAINS[self.domain], fit_levels(noisy.float(), variance.float())
        signal = domain.forward(noisy.float(), *levels)
        maps = [domain.relative_deviation(noisy.float(), variance.float(), *levels)] if self.variance_map else []
        correction = self._correction(signal, *maps, *self._distances(signal, levels))
        correction = maps[0] * correction if self.variance_map else correction
        return domain.inverse(self.base_image(signal) + correction, *levels).to(noisy.dtype)

    def _mend(self, noisy: Tensor, levels: tuple[Tensor, Tensor], mend: Callable[[Tensor], Tensor]) -> Tensor:
        domain = DOMAINS[self.domain]
        signal = domain.forward(noisy.float(), *levels)
        repaired = mend(signal)
        return torch.where(repaired == signal, noisy, domain.inverse(repaired, *levels).to(noisy.dtype))

    def _at_scales(self, noisy: Tensor, variance: Tensor | None, clipped: Tensor, halvings: int) -> Tensor:
        """The recursion ``g(y) = f(y) + U k(g(B y) - B f(y))``; ``clipped`` is the share of clipped values."""
        denoised = self._at_one_scale(noisy, variance)
        if not halvings:
            return denoised
        small, seen, share = (halve(pad_to_multiple(x, 4)) for x in (noisy, denoised, clipped))
        part = bayer.bin_mosaic_variance(2) if self.channels == PACKED else 0.25
        told = None if variance is None else part * halve(pad_to_multiple(variance, 4))
        wide = smooth_correction(self._at_scales(small, told, share, halvings - 1) - seen, share)
        height, width = noisy.shape[-2:]
        return denoised + double(wide)[..., :height, :width]

    def _distances(self, signal: Tensor, levels: tuple[Tensor, Tensor]) -> list[Tensor]:
        """The distances of a signal from black and from white, up to :data:`NEAR`, if the network takes them."""
        white = DOMAINS[self.domain].forward(torch.ones_like(levels[0]), *levels)
        return [signal.clamp_max(NEAR), (white - signal).clamp_max(NEAR)] if self.limits else []

    def _correction(self, signal: Tensor, *maps: Tensor) -> Tensor:
        features = torch.cat([signal, *maps], dim=1) if maps else signal
        correction = self.residual(pad_to_multiple(features.to(self._dtype), self.multiple))
        height, width = (self.upscale * side for side in signal.shape[-2:])
        return correction[..., :height, :width]

    @property
    def _dtype(self) -> torch.dtype:
        return next((p.dtype for p in self.parameters()), torch.get_default_dtype())

    def _require_type(self, image: Tensor, what: str) -> None:
        """Raise ValueError unless an image has the type of the weights; mixed precision converts by itself."""
        if not image.is_floating_point():
            raise ValueError(f"{what} must be floating-point RAW with white at 1, got {image.dtype}")
        if image.dtype != self._dtype and not torch.is_autocast_enabled(image.device.type):
            raise ValueError(f"{what} is {image.dtype} but the network is {self._dtype}; convert one of them")

    def can_start_from(self, model: Denoiser) -> bool:
        """Whether :meth:`start_from` can take a network's weights: its class and its settings fit this one's."""
        if not isinstance(self, type(model)):
            return False

        for key in self.config.keys() & model.config.keys():
            larger = key in self.growing and self.config[key] > model.config[key]
            if self.config[key] != model.config[key] and not larger:
                return False

        return True

    def start_from(self, model: Denoiser) -> None:
        """Take the weights of a network of this class or of one of its bases; layers beyond those stay as they are."""
        complete = type(self) is type(model) and self.config == model.config
        self.load_state_dict(model.state_dict(), strict=complete)

    @torch.no_grad()
    def initialise(self, seed: int, *zeros: nn.Conv2d, gain: float = HE_GAIN) -> None:
        """Draw all convolutions anew (He et al. 2015), deviation ``gain / sqrt(fan in)``, biases and ``zeros`` zero.

        The numbers come from a CPU generator of ``seed``: the same on every device, and the global state is untouched.
        """
        generator = torch.Generator("cpu").manual_seed(seed)
        for module in self.modules():
            if not isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)) or module.weight.is_meta:
                continue
            if module in zeros:
                module.weight.zero_()
            else:
                # Transposed convolutions here have as many taps as strides: each output has one of them.
                upwards = isinstance(module, nn.ConvTranspose2d)
                fan_in = module.in_channels if upwards else math.prod(module.weight.shape[1:])
                draw = torch.empty(module.weight.shape, device="cpu")
                deviation = gain / math.sqrt(fan_in)
                module.weight.copy_(nn.init.normal_(draw, 0.0, deviation, generator=generator))
            if module.bias is not None:
                module.bias.zero_()
