r"""One network for mosaics of every pattern: it sees the mosaic, and which colour each of its pixels has.

Domain: ``(B, 4, H, W)``, the mosaic, white = 1, and planes that are 1 at the sites of a colour (:func:`with_planes`),
to the mosaic ``(B, 1, H, W)``. A site's values enter the first layer by place and colour,

.. math:: u_{c s} = m_{c s} \, (z_s - \bar z_c), \qquad z'_s = z_s + \sum_c m_{c s} \, r_{c s},

with s one of the four pixels of a 2 x 2 square, m the planes, z the transformed signal, :math:`\bar z_c` the mean of a
colour over a cell of the last scale and r the last layer's result. For RGGB these are packed RAW's planes, with zeros
between them, so that a network may begin as a :class:`denoisers.DRUNet` of packed RAW; of X-Trans eight squares of nine
hold a red, two greens and a blue as well. At half its sides every mosaic becomes one of RGGB.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.domains import DOMAINS, fit_levels
from denoisers.network import DEFECT, DENOISERS, PACKED, Denoiser, conv, pad_to_multiple, smooth_correction
from denoisers.networks import CONTEXT, DRUNet
from rawaug import bayer

RGB = 3
SITES = 4
"""Pixels of a 2 x 2 square."""
SPREAD = RGB * SITES

Levels = tuple[Tensor, Tensor]
"""shot_var and read_var, ``(B, 1, 1, 1)``, or of every pixel ``(B, 1, H, W)``."""

_MET = ("RGGB", "XTRANS", "QUAD-RGGB+1+1")
"""The phases in which a network meets the patterns: most of the 2 x 2 squares then hold all three colours."""


def entry_pattern(pattern: bayer.Pattern) -> bayer.Pattern:
    """The pattern as a network is trained to meet it: from its own origin, or from one line above or to the left."""
    places = {known.shift(i, j) for known in map(bayer.pattern, _MET) for i in range(0, 6, 2) for j in range(0, 6, 2)}
    return next(moved for i in (0, 1) for j in (0, 1) if (moved := pattern.shift(-i, -j)) in places)


def lines_before(pattern: bayer.Pattern) -> tuple[int, int]:
    """Count the lines that a mosaic of the pattern lacks, above and on the left, to begin as networks meet it."""
    entry = entry_pattern(pattern)
    return next((i, j) for i in (0, 1) for j in (0, 1) if pattern.shift(-i, -j) == entry)


def with_planes(mosaic: Tensor, pattern: bayer.Pattern) -> Tensor:
    """Put the planes of its colours behind a mosaic ``(B, 1, H, W)``: ``(B, 4, H, W)``."""
    planes = pattern.planes(*mosaic.shape[-2:]).to(mosaic)
    return torch.cat([mosaic, planes.expand(len(mosaic), -1, -1, -1)], dim=1)


def denoise_mosaic(run: Callable[[Tensor, Tensor], Tensor], mosaic: Tensor, variance: Tensor, cfa: str) -> Tensor:
    """Denoise a mosaic of any pattern and phase.

    Where the network is trained to meet the pattern one line earlier, the mosaic gets a mirrored line above or on the
    left, which is cropped from the result.

    Args:
        run: a :class:`MosaicDRUNet`, or a function that denoises by one tile after the other.
        mosaic: ``(1, 1, H, W)``, white = 1.
        variance: the noise variance of each value, of the same shape.
        cfa: the name of the pattern.

    Returns:
        The denoised mosaic ``(1, 1, H, W)``.
    """
    known = bayer.pattern(cfa)
    top, left = lines_before(known)
    noisy, told = (F.pad(x, (left, 0, top, 0), mode="reflect") for x in (with_planes(mosaic, known), variance))
    return run(noisy, told)[..., top:, left:]


def mend_mosaic(signal: Tensor, planes: Tensor) -> Tensor:
    """Replace the hot and dead pixels of a mosaic ``(B, 1, H, W)``, whose noise has deviation 1.

    ``planes`` ``(B, 3, H, W)`` say which colour each pixel has. A defect lies beyond all pixels of its colour within
    two of it by :data:`denoisers.network.DEFECT`, while the pixels that touch it depart less from theirs. It becomes
    the mean of its neighbours without their lowest and highest.
    """
    near = _neighbours(torch.cat([signal, planes.argmax(1, keepdim=True).to(signal)], dim=1), 2)
    colour = planes.argmax(1, keepdim=True)
    infinity = torch.full_like(signal, torch.inf)
    low, high = infinity, -infinity
    total, count = torch.zeros_like(signal), torch.zeros_like(signal)
    for value, other in (pixel.split(1, dim=1) for pixel in near):
        same = other == colour
        low, high = torch.where(same, value.minimum(low), low), torch.where(same, value.maximum(high), high)
        total, count = total + value * same, count + same
    mean = (total - low - high) / (count - 2).clamp_min(1)
    deviations, share = DEFECT
    beyond = (signal > high + share * high.abs() + deviations) | (signal < low - share * low.abs() - deviations)
    departure = (signal - mean).abs()
    others = torch.cat(_neighbours(departure, 1), dim=1).amax(1, keepdim=True)
    return torch.where(beyond & (count > 2) & (departure > 4.0 * others), mean, signal)


def _neighbours(image: Tensor, reach: int) -> list[Tensor]:
    """The pictures ``(B, C, H, W)`` of all neighbours within ``reach``, mirrored at the edges."""
    height, width = image.shape[-2:]
    padded, side = F.pad(image, (reach,) * 4, mode="reflect"), range(2 * reach + 1)
    places = [(i, j) for i in side for j in side if (i, j) != (reach, reach)]
    return [padded[..., i : i + height, j : j + width] for i, j in places]


@DENOISERS.register("MosaicDRUNet")
class MosaicDRUNet(DRUNet):
    """:class:`denoisers.DRUNet` for mosaics of every pattern: Bayer's in all phases, X-Trans, Quad-Bayer.

    It starts from the weights of a DRUNet of packed RAW with the same settings, if asked to: on RGGB it is then that
    network, but for the borders and a mean over both greens.

    Args:
        width, scales, blocks, limits, mend, domain, pyramid, seed: see :class:`denoisers.DRUNet`.

    Example:
        >>> planes = bayer.pattern("XTRANS").planes(30, 36).expand(2, -1, -1, -1)
        >>> noisy = torch.cat([torch.rand(2, 1, 30, 36), planes], dim=1)
        >>> MosaicDRUNet(width=4)(noisy, torch.full((2, 1, 30, 36), 1e-4)).shape
        torch.Size([2, 1, 30, 36])
    """

    def __init__(
        self,
        width: int = 32,
        scales: int = 4,
        blocks: int = 1,
        limits: bool = True,
        mend: bool = True,
        domain: str = "anscombe",
        pyramid: int = 0,
        seed: int = 0,
    ) -> None:
        if domain == "linear":
            raise ValueError("domain linear supports packed RAW only; choose ksigma or anscombe")
        super().__init__(
            width, scales, blocks, limits, mend, pyramid=pyramid, variance_map=False, domain=domain, seed=seed
        )
        own = {"width": width, "scales": scales, "blocks": blocks, "limits": limits, "mend": mend}
        self.config = {**own, "domain": domain} | ({"pyramid": pyramid} if pyramid else {})
        self.multiple, self.stride = 2 * self.multiple, 2 * self.stride
        self.head = conv(SPREAD * (2 + 2 * limits), width, bias=False)
        self.coarse = conv(RGB, self.coarse.out_channels, bias=False)
        self.tail = conv(width, SPREAD, bias=False)
        self.initialise(seed, self.tail, *self.block_ends(), gain=1.0)

    @torch.no_grad()
    def start_from(self, model: Denoiser) -> None:
        """Take the weights of a network of this class, or of a DRUNet of packed RAW, spreading its planes by site."""
        state = model.state_dict()
        if not isinstance(model, MosaicDRUNet):
            head = state["head.weight"].unflatten(1, (-1, PACKED))
            spread = torch.stack([_by_site(planes) for planes in head.unbind(1)], dim=1).flatten(1, 2)
            colours = torch.zeros_like(spread[:, :SPREAD])
            state["head.weight"] = torch.cat([spread, colours], dim=1)
            state["tail.weight"] = _by_site(state["tail.weight"].transpose(0, 1)).transpose(0, 1)
            red, green, other, blue = state["coarse.weight"].unbind(1)
            state["coarse.weight"] = torch.stack([red, green + other, blue], dim=1)
        self.load_state_dict(state)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise a mosaic with its planes, ``(B, 4, H, W)``; ``variance`` and the result are ``(B, 1, H, W)``."""
        name = type(self).__name__
        if noisy.ndim != 4 or noisy.shape[1] != 1 + RGB or min(noisy.shape[-2:]) < 4:
            raise ValueError(f"{name} takes a mosaic and its planes, (B, 4, H >= 4, W >= 4), got {tuple(noisy.shape)}")
        self._require_type(noisy, "noisy")
        raw, planes = noisy[:, :1], noisy[:, 1:]
        variance = self._require_variance(raw, variance)
        levels = fit_levels(raw.float(), variance.float())
        whole = self._mend(raw, levels, partial(mend_mosaic, planes=planes)) if self.mend else raw
        denoised = self._at_halves(whole, planes, levels, (whole >= 1.0).to(raw), self.pyramid)
        return torch.where(variance > 0, denoised, raw)

    def _at_halves(self, raw: Tensor, planes: Tensor, levels: Levels, clipped: Tensor, halvings: int) -> Tensor:
        """The recursion ``g(y) = f(y) + U k(g(B y) - B f(y))`` of :class:`Denoiser`; B y is a mosaic of RGGB."""
        denoised = self._of_mosaic(raw, planes, levels)
        if not halvings:
            return denoised
        even = pad_to_multiple(torch.cat([raw, denoised, clipped, planes], dim=1), 4)
        halving = bayer.Halving(even[:, 3:])
        small, seen, share = (halving(even[:, k : k + 1]) for k in range(3))
        half, clipped = (F.pixel_shuffle(x, 2) for x in (small, share))
        shot, read = (F.pixel_shuffle(halving.variance(_padded(level)), 2) for level in levels)
        colours = bayer.pattern("RGGB").planes(*half.shape[-2:]).to(half).expand(len(half), -1, -1, -1)
        found = self._at_halves(half, colours, (shot, read), clipped, halvings - 1)
        height, width = raw.shape[-2:]
        added = halving.back(smooth_correction(F.pixel_unshuffle(found, 2) - seen, share))[..., :height, :width]
        return denoised + (added * planes).sum(1, keepdim=True)

    def _of_mosaic(self, raw: Tensor, planes: Tensor, levels: Levels) -> Tensor:
        domain = DOMAINS[self.domain]
        signal = domain.forward(raw.float(), *levels)
        maps = [planes, signal, *self._distances(signal, levels)]
        features = pad_to_multiple(torch.cat(maps, dim=1).to(self._dtype), self.multiple)
        correction = self.residual(features)[..., : raw.shape[-2], : raw.shape[-1]]
        return domain.inverse(signal + correction, *levels).to(raw.dtype)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, 1, H, W)`` from planes, signal and limits ``(B, 4 or 6, H, W)``."""
        planes, maps = features[:, :RGB], features[:, RGB:]
        sites = F.pixel_unshuffle(planes, 2)
        spread = [F.pixel_unshuffle(planes * one, 2) for one in maps.split(1, dim=1)]
        cell = 2 * self.cell
        mean = F.avg_pool2d(planes * maps[:, :1], cell) / F.avg_pool2d(planes, cell).clamp_min(1e-6)
        light = F.interpolate(mean, sites.shape[-2:], mode="bilinear").repeat_interleave(SITES, dim=1)
        spread[0] = spread[0] - light * sites
        wide = F.interpolate(F.avg_pool2d(mean, CONTEXT), mean.shape[-2:], mode="bilinear")
        x = self.trunk(self.head(torch.cat([*spread, sites], dim=1)), self.coarse(self.cell * (mean - wide)))
        correction = (self.tail(x) * sites).unflatten(1, (RGB, SITES)).sum(1)
        return F.pixel_shuffle(correction, 2)


class BayerAdapter(nn.Module):
    """A :class:`MosaicDRUNet` that is called like a network of packed RAW, ``(B, 4, h, w)`` of RGGB."""

    reads_variance = True

    def __init__(self, network: MosaicDRUNet) -> None:
        super().__init__()
        self.network = network
        self.stride = network.stride // 2
        self.mixed = network.mixed

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Denoise packed RAW ``(B, 4, h, w)`` with a variance map of the same shape."""
        raw, told = (bayer.unpack(x, bayer.CFA.RGGB) for x in (noisy, variance))
        return bayer.pack(self.network(with_planes(raw, bayer.pattern("RGGB")), told), bayer.CFA.RGGB)


def _padded(level: Tensor) -> Tensor:
    return pad_to_multiple(level, 4) if level.shape[-1] > 1 else level


def _by_site(packed: Tensor) -> Tensor:
    """Weights of R, Gr, Gb, B, ``(n, 4, 3, 3)``, for every colour at every site of a square, ``(n, 12, 3, 3)``."""
    red, green, other, blue = packed.unbind(1)
    mean = (green + other) / 2
    return torch.stack([*[red] * SITES, mean, green, other, mean, *[blue] * SITES], dim=1)
