r"""One network for mosaics of every pattern: it sees the mosaic, and which colour each of its pixels has.

Domain: from ``(B, 4, H, W)``, which is the mosaic with white = 1 and planes that are 1 at the sites of a colour
(:func:`with_planes`), to the mosaic ``(B, 1, H, W)``. A site's values enter the first layer by place and colour,

.. math:: u_{c s} = m_{c s} \, (z_s - \bar z_c), \qquad z'_s = z_s + \sum_c m_{c s} \, r_{c s},

where s is one of the four pixels of a 2 x 2 square, m are the planes, z is the transformed signal, :math:`\bar z_c` is
the mean of a colour over a cell of the last scale, and r is the last layer's result. For RGGB these are packed RAW's
planes with zeros between them, so that a network may begin as a :class:`denoisers.DRUNet` of packed RAW. In X-Trans,
eight squares of nine also hold a red, two greens and a blue. At half its sides, every mosaic becomes one of RGGB.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.defects import mend_mosaic
from denoisers.domains import DOMAINS, Levels, fit_levels
from denoisers.drunet import ResidualUNet, Size
from denoisers.layers import PACKED, pad_to_multiple
from denoisers.network import DENOISERS, Denoiser
from denoisers.pyramid import smooth_correction
from rawaug import bayer

RGB = 3
SITES = 4
"""A 2 x 2 square has this many pixels."""
SPREAD = RGB * SITES
"""A plane that is spread by colour and site has this many channels."""

_ENTRIES = ("RGGB", "XTRANS", "QUAD-RGGB+1+1")
"""A network meets the patterns in these phases, where most of the 2 x 2 squares hold all three colours."""
_PERIOD = 6
"""This is the largest period of these patterns in pixels."""


def lines_before(pattern: bayer.Pattern) -> tuple[int, int]:
    """Count the lines that a mosaic lacks above and on the left to begin as networks meet its pattern.

    Raises:
        ValueError: if no network meets the pattern.
    """
    entries = set()
    for name in _ENTRIES:
        for row, column in product(range(0, _PERIOD, 2), repeat=2):
            entries.add(bayer.pattern(name).shift(row, column))

    for above, before in product((0, 1), repeat=2):
        if pattern.shift(-above, -before) in entries:
            return above, before
    raise ValueError(f"no network denoises mosaics of the pattern {pattern}; use one of {', '.join(bayer.PATTERNS)}")


def entry_pattern(pattern: bayer.Pattern) -> bayer.Pattern:
    """Move a pattern to the origin where networks are trained to meet it: its own, or one line above or to the left."""
    above, before = lines_before(pattern)
    return pattern.shift(-above, -before)


def with_planes(mosaic: Tensor, pattern: bayer.Pattern) -> Tensor:
    """Append to a mosaic ``(B, 1, H, W)`` the planes of its colours, which makes ``(B, 4, H, W)``."""
    planes = pattern.planes(*mosaic.shape[-2:]).to(mosaic)
    return torch.cat([mosaic, planes.expand(len(mosaic), -1, -1, -1)], dim=1)


def denoise_mosaic(run: Callable[[Tensor, Tensor], Tensor], mosaic: Tensor, variance: Tensor, cfa: str) -> Tensor:
    """Denoise a mosaic of any pattern and phase.

    If the network is trained to meet the pattern one line earlier, the mosaic gets a mirrored line above or on the
    left, which is cropped from the result.

    Args:
        run: a :class:`MosaicDRUNet`, or a function that denoises by one tile after the other.
        mosaic: ``(1, 1, H, W)``, white = 1.
        variance: the noise variance of each value, of the same shape.
        cfa: the name of the pattern.

    Returns:
        The denoised mosaic ``(1, 1, H, W)``.
    """
    pattern = bayer.pattern(cfa)
    above, before = lines_before(pattern)
    margin = (before, 0, above, 0)

    noisy = F.pad(with_planes(mosaic, pattern), margin, mode="reflect")
    denoised = run(noisy, F.pad(variance, margin, mode="reflect"))
    return denoised[..., above:, before:]


@DENOISERS.register("MosaicDRUNet")
class MosaicDRUNet(ResidualUNet):
    """:class:`denoisers.DRUNet` for mosaics of every pattern: Bayer's in all phases, X-Trans, Quad-Bayer.

    If asked to, it starts from the weights of a DRUNet of packed RAW with the same settings. On RGGB it is then that
    network, except for the borders and a mean over both greens.

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

        config: dict[str, object] = {"domain": domain}
        if pyramid:
            config["pyramid"] = pyramid
        size = Size(width, scales, blocks)
        super().__init__(config, size, limits, mend, pyramid, multiple=2, variance_map=False, domain=domain, seed=seed)

        maps = 1 + 2 * limits  # the signal, and its distances from black and from white
        self.add_layers(SPREAD * (maps + 1), RGB, SPREAD)
        self.initialise(self.seed, self.tail, *self.block_ends(), gain=1.0)

    @torch.no_grad()
    def start_from(self, model: Denoiser) -> None:
        """Take the weights of a network of this class, or of a DRUNet of packed RAW, spreading its planes by site.

        Blocks beyond those of the other network stay as they are.
        """
        state = model.state_dict()
        if not isinstance(model, MosaicDRUNet):
            head = state["head.weight"].unflatten(1, (-1, PACKED))
            maps = [_by_site(weight) for weight in head.unbind(1)]
            colours = torch.zeros_like(maps[0])
            state["head.weight"] = torch.cat([*maps, colours], dim=1)
            state["tail.weight"] = _by_site(state["tail.weight"].transpose(0, 1)).transpose(0, 1)

            red, green_in_red, green_in_blue, blue = state["coarse.weight"].unbind(1)
            state["coarse.weight"] = torch.stack([red, green_in_red + green_in_blue, blue], dim=1)

        is_complete = self.config["blocks"] == model.config["blocks"]
        self.load_state_dict(state, strict=is_complete)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise a mosaic with its planes, ``(B, 4, H, W)``; ``variance`` and the result are ``(B, 1, H, W)``."""
        name = type(self).__name__
        if noisy.ndim != 4 or noisy.shape[1] != 1 + RGB or min(noisy.shape[-2:]) < 4:
            raise ValueError(f"{name} takes a mosaic and its planes, (B, 4, H >= 4, W >= 4), got {tuple(noisy.shape)}")
        self._require_type(noisy, "noisy")
        raw = noisy[:, :1]
        planes = noisy[:, 1:]
        variance = self._require_variance(raw, variance)

        levels = fit_levels(raw.float(), variance.float())
        mended = raw
        if self.mend:
            mended = self._mend(raw, levels, partial(mend_mosaic, planes=planes))

        clipped = (mended >= 1.0).to(raw)
        denoised = self._at_halves(mended, planes, levels, clipped, self.pyramid)
        return torch.where(variance > 0, denoised, raw)

    def _at_halves(self, raw: Tensor, planes: Tensor, levels: Levels, clipped: Tensor, halvings: int) -> Tensor:
        """Run the recursion of :mod:`denoisers.pyramid`, g(y) = f(y) + U k(g(B y) - B f(y)); B y is a mosaic of RGGB.

        Args:
            raw: the mosaic ``(B, 1, H, W)``.
            planes: the planes of its colours, ``(B, 3, H, W)``.
            levels: the levels of its noise.
            clipped: the share of clipped values, ``(B, 1, H, W)``.
            halvings: how many times the sides are halved from here on.
        """
        denoised = self._of_mosaic(raw, planes, levels)
        if not halvings:
            return denoised

        even = pad_to_multiple(torch.cat([raw, denoised, clipped, planes], dim=1), 4)
        halving = bayer.Halving(even[:, 3:])
        packed = halving(even[:, :1])
        packed_denoised = halving(even[:, 1:2])
        packed_clipped = halving(even[:, 2:3])

        half = F.pixel_shuffle(packed, 2)
        half_levels = (_half_variance(halving, levels[0]), _half_variance(halving, levels[1]))
        half_planes = bayer.pattern("RGGB").planes(*half.shape[-2:]).to(half).expand(len(half), -1, -1, -1)
        half_clipped = F.pixel_shuffle(packed_clipped, 2)

        coarse = self._at_halves(half, half_planes, half_levels, half_clipped, halvings - 1)
        difference = F.pixel_unshuffle(coarse, 2) - packed_denoised
        by_colour = halving.back(smooth_correction(difference, packed_clipped))

        height, width = raw.shape[-2:]
        correction = (by_colour[..., :height, :width] * planes).sum(1, keepdim=True)
        return denoised + correction

    def _of_mosaic(self, raw: Tensor, planes: Tensor, levels: Levels) -> Tensor:
        """Denoise without the pyramid: f."""
        domain = DOMAINS[self.domain]
        signal = domain.forward(raw.float(), *levels)
        maps = [planes, signal, *self.distances(signal, levels)]
        features = pad_to_multiple(torch.cat(maps, dim=1).to(self._dtype), self.multiple)

        height, width = raw.shape[-2:]
        correction = self.residual(features)[..., :height, :width]
        return domain.inverse(signal + correction, *levels).to(raw.dtype)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, 1, H, W)`` from planes, signal and limits ``(B, 4 or 6, H, W)``."""
        planes = features[:, :RGB]
        signal, *limits = features[:, RGB:].split(1, dim=1)
        sites = F.pixel_unshuffle(planes, 2)

        cell = 2 * self.cell
        mean = F.avg_pool2d(planes * signal, cell) / F.avg_pool2d(planes, cell).clamp_min(1e-6)
        light = F.interpolate(mean, sites.shape[-2:], mode="bilinear").repeat_interleave(SITES, dim=1)

        spread = [F.pixel_unshuffle(planes * signal, 2) - light * sites]
        for limit in limits:
            spread.append(F.pixel_unshuffle(planes * limit, 2))
        x = self.head(torch.cat([*spread, sites], dim=1))
        x = self.trunk(x, self.coarse(self.wide_signal(mean)))

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
        mosaic = bayer.unpack(noisy, bayer.CFA.RGGB)
        mosaic_variance = bayer.unpack(variance, bayer.CFA.RGGB)
        denoised = self.network(with_planes(mosaic, bayer.pattern("RGGB")), mosaic_variance)
        return bayer.pack(denoised, bayer.CFA.RGGB)


def _half_variance(halving: bayer.Halving, level: Tensor) -> Tensor:
    """Bring a level, one for all pixels or one each, to half the sides: one each, ``(B, 1, H/2, W/2)``."""
    if level.shape[-1] > 1:
        level = pad_to_multiple(level, 4)
    return F.pixel_shuffle(halving.variance(level), 2)


def _by_site(packed: Tensor) -> Tensor:
    """Spread weights of R, Gr, Gb, B, ``(n, 4, 3, 3)``, to all colours at all sites of a square, ``(n, 12, 3, 3)``."""
    red, green_in_red, green_in_blue, blue = packed.unbind(1)
    mean = (green_in_red + green_in_blue) / 2
    greens = [mean, green_in_red, green_in_blue, mean]
    return torch.stack([*[red] * SITES, *greens, *[blue] * SITES], dim=1)
