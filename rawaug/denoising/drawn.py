r"""Pictures that nobody took: screenshots, dithered pictures and halftones, whose grain is not noise.

.. math:: \rho_1 = \frac{\sum_f P(f) \cos 2 \pi f}{\sum_f P(f)}, \qquad
   q = \max_f \frac{P(f)}{\operatorname{median}_{|f' - f| \le 3} P(f')}

P is the mean power spectrum of the luma's fine detail in the flatter half of squares of 32 x 32 pixels. A sensor's
noise never repeats exactly, is never less alike between neighbours than white noise (:math:`\rho_1` about 0), and has a
smooth spectrum (q below 4). A screenshot repeats the colour of its neighbours, a dithered picture has few colours or
grain that alternates (:math:`\rho_1` about -0.3; the error diffusion of Floyd and Steinberg, 1976), and the dots of a
halftone are lines in the spectrum (q above 20).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.denoising.picture_levels import spread_parts
from rawaug.errors import count_of

FEW_COLOURS, FEW_GREYS = 256, 36
"""A picture with at most so many colours, or shades of grey, was made from a palette."""
MOST_REPEATS, LEAST_CONSTANT, LEAST_IN_VARIED = 0.3, 0.1, 0.05
"""A drawn picture repeats more than this share of its pixels, and has either more constant squares or more repeats in
the median of the others; a noisy photograph with constant areas has no repeats in the others."""
LOWEST_CORRELATION, HIGHEST_PEAK = -0.25, 20.0
"""The limits of rho and of q; noisy photographs stay above -0.1 and below 5."""
_CLIPPED = 2.5 / 255.0
"""Black borders and blown-out skies, as close to the ends of the range as this, repeat in photographs too."""

_SQUARE, _SPECTRUM = 16, 32
"""Sides in pixels of the squares in which repeats are counted, and of those of the spectrum."""
_SMALLEST_SIDE = 64
"""Smaller pictures are not judged."""


def explain_drawn(srgb: Tensor) -> str | None:
    """Explain by what a picture ``(1, 3, H, W)`` in [0, 1] is drawn rather than taken; None if it may be a photograph.

    Parts that are spread over the picture are looked at, as for the level of the noise.

    Example:
        >>> explain_drawn(torch.rand(1, 3, 64, 64)) is None
        True
        >>> explain_drawn(torch.rand(1, 3, 64, 64).round())
        'it has 8 colours, as a picture with a palette has'
    """
    if min(srgb.shape[-2:]) < _SMALLEST_SIDE:
        return None

    parts = list(spread_parts(srgb))
    codes = torch.cat([part[0].flatten(1) for part in parts], dim=1).mul(65535).round().long()
    is_grey = bool((codes == codes[:1]).all())
    colours = (codes[0] << 32 | codes[1] << 16 | codes[2]).unique().numel()
    if colours <= (FEW_GREYS if is_grey else FEW_COLOURS):
        return f"it has {count_of(colours, 'colour')}, as a picture with a palette has"

    repeats = torch.cat([_count_repeats(part) for part in parts])
    constant = repeats == 1.0
    has_repeats = constant.float().mean() > LEAST_CONSTANT or repeats[~constant].median() > LEAST_IN_VARIED
    if repeats.mean() > MOST_REPEATS and has_repeats:
        return f"{100 * repeats.mean():.0f} % of its pixels repeat their neighbours exactly, as in a screenshot"

    spectrum = _measure_spectrum(parts)
    waves = torch.cos(2 * torch.pi * torch.fft.fftfreq(_SPECTRUM))
    along_rows, along_columns = spectrum.sum(0) @ waves, spectrum.sum(1) @ waves
    if (along_rows + along_columns) / (2 * spectrum.sum()) < LOWEST_CORRELATION:
        return "its grain alternates from pixel to pixel, as in a dithered picture"

    shifted = F.pad(spectrum[None, None], (3, 3, 3, 3), mode="circular")
    around = F.unfold(shifted, 7)[0].median(0).values.reshape(spectrum.shape)
    peaks = spectrum / (around + 1e-3 * spectrum.mean())
    if peaks[1:, 1:].max() > HIGHEST_PEAK:  # blocks of JPEG are lines along the axes
        return "its grain is periodic, as in a halftone"
    return None


def _count_repeats(part: Tensor) -> Tensor:
    """Count the pixels like those above and beside them: shares of the unclipped squares of ``(1, 3, h, w)``."""
    pixels = part[..., 1:, 1:]
    repeats = (pixels == part[..., :-1, 1:]) & (pixels == part[..., 1:, :-1])
    clipped = ((pixels - 0.5).abs() > 0.5 - _CLIPPED).all(1, keepdim=True)
    planes = torch.cat([repeats.all(1, keepdim=True), clipped], dim=1).float()

    shares = F.avg_pool2d(planes, min(_SQUARE, *planes.shape[-2:])).flatten(2)[0]
    repeated, clipped_share = shares
    return repeated[clipped_share < 1.0]


def _measure_spectrum(parts: list[Tensor]) -> Tensor:
    """Measure the mean power spectrum of fine detail in the flatter half of the squares, ``(32, 32)``."""
    squares = []
    for part in parts:
        luma = part.mean(1, keepdim=True)
        detail = luma - F.avg_pool2d(F.pad(luma, (2, 2, 2, 2), mode="reflect"), 5, 1)
        squares.append(F.unfold(detail, _SPECTRUM, stride=_SPECTRUM)[0].T)

    detail = torch.cat(squares).reshape(-1, _SPECTRUM, _SPECTRUM)
    power = detail.square().mean((1, 2), keepdim=True)
    flat = (power <= power.median()).flatten()
    window = torch.hann_window(_SPECTRUM)
    scaled = detail[flat] / (power[flat].sqrt() + 1e-4) * window * window[:, None]
    return torch.fft.fft2(scaled).abs().square().mean(0)
