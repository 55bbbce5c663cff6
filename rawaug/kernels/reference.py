r"""The passes in PyTorch, for any device: the definition that the compiled kernels are tested against.

The reverse pass of a baked ISP, pixel by pixel: look-up, blur, colour, gains, shading, mosaic, clip.

.. math:: y_c = \min(\sum_k C_{ck} (B T_k)(x) \, (floor_c + m \, rise_c) \, G(p) \, A(x_4),\ white), \qquad
    m = \mathrm{clip}((\bar x_3 - knee) / (1 - knee), 0, 1)^2

with :math:`floor = 1 / g` and :math:`rise = \max(1 - 1 / g, 0)`, which is Brooks' ``max(m + (1 - m) / g, 1 / g)``.
Each site computes only the colour that its mosaic keeps.

B blurs linear light by a Gaussian of deviation :math:`\sigma \leq 1` pixels, with five taps (c, b, a, b, c) along rows
and columns,

.. math:: b = \frac{\sigma^2 / 2}{1 + \sigma^6}, \qquad c = \frac{\sigma^2 - 2 b}{8}, \qquad a = 1 - 2 b - 2 c,

which have a variance of exactly :math:`\sigma^2`, are (1, 4, 6, 4, 1) / 16 at 1, and differ from the samples of a
Gaussian of that variance by less than 0.01.

Normal numbers are made by counting: number k of cell i is a function of (key, i, k) alone.

.. math:: (w_0, w_1, w_2, w_3) = \mathrm{Philox4x32\text{-}10}(i; key), \qquad
    n_{0, 1} = \sqrt{-2 \ln u(w_0)} \, (\cos, \sin)(2 \pi w_1 / 2^{32}), \quad u(w) = (w + 1/2) / 2^{32}

and likewise :math:`n_{2, 3}` from :math:`w_2, w_3` (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC
2011; Box and Muller 1958): the four normals of a Bayer cell, up to 6.7 standard deviations, in any order of the cells.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, STENCILS, demosaicing_stencils
from rawaug.kernels.runtime import move_together

MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
INCREMENTS = (0x9E3779B9, 0xBB67AE85)
ROUNDS = 10
_LOW = 0xFFFFFFFF

BAND = 2**19
"""A CPU works on this many pixels at a time, which bounds its memory."""


class Unprocessing(NamedTuple):
    """The numbers of the reverse pass, float32; an absent part is an empty tensor.

    The tables are on the device of the pictures. The numbers of each picture are on the host, and cross with the pass.

    Args:
        table: ``(N, N, N, 4)`` x2 over the sRGB cube, axes B, G, R; the last of the four is not used. Empty if the
            pictures have curves.
        curves: ``(B, T)`` x2 over the sRGB code, one curve a picture for all of its channels; T is 256 for uint8, where
            it is not interpolated. Empty if there is a table.
        attention: ``(N, N, N, 4)``, A in the first of the four over the cube of x4; or empty.
        colour: ``(B, 6, 3)``: the rows of the matrix, their mean, floor, rise.
        knee: mean of x3 where the gains start to spare highlights.
        frame: ``(B, 6)`` y and x about the mask's centre of the first pixel, of a step down, and of one to the right.
        shading: ``(3,)`` a, b, c of the mask ``G = 2^-(a y^2 + b x y + c x^2)``; or empty, for none.
        sites: row and column within the cell, and colour, of R, Gr, Gb, B.
        taps: ``(B, 3)`` a, b, c of the blur; or empty, for none.
    """

    table: Tensor
    curves: Tensor
    attention: Tensor
    colour: Tensor
    knee: float
    frame: Tensor
    shading: Tensor
    sites: tuple[tuple[int, int, int], ...]
    taps: Tensor


def mask_frame(place: list[int], height: int, width: int, centre: tuple[float, float]) -> list[float]:
    """Compute one row of :attr:`Unprocessing.frame`.

    Args:
        place: top, left, height and width of the full frame, and, if the crop was turned or enlarged, its view and how
            many rows of the frame became ``height``.
        height, width: sides of the picture.
        centre: (y, x) of the mask.
    """
    top, left, frame_height, frame_width, view, rows = (*place, 0, 0)[:6]
    step = 1.0
    if rows:
        step = rows / height
    half_diagonal = 0.5 * math.hypot(frame_height, frame_width)

    def position(i: int, j: int) -> tuple[float, float]:
        """Find where pixel (i, j) of the picture lies in the frame; its view is undone first."""
        if view & 2:
            i = height - 1 - i
        if view & 1:
            j = width - 1 - j
        if view & 4:
            i, j = j, i

        y = ((i + 0.5) * step + top - frame_height / 2) / half_diagonal
        x = ((j + 0.5) * step + left - frame_width / 2) / half_diagonal
        return y - centre[0], x - centre[1]

    (y, x), down, right = position(0, 0), position(1, 0), position(0, 1)
    return [y, x, down[0] - y, down[1] - x, right[0] - y, right[1] - x]


def blur_taps(deviation: Tensor) -> Tensor:
    """Compute :attr:`Unprocessing.taps` ``(B, 3)`` of deviations ``(B,)`` from 0 to 1 pixel."""
    variance = deviation.square()
    near = 0.5 * variance / (1.0 + variance * variance * variance)
    far = (variance - 2.0 * near) / 8.0
    return torch.stack([1.0 - 2.0 * near - 2.0 * far, near, far], dim=1)


def blur(light: Tensor, taps: Tensor) -> Tensor:
    """Blur pictures ``(B, C, H, W)`` along both axes by :func:`blur_taps`; the edge is repeated outwards."""
    height, width = light.shape[-2:]
    a, b, c = taps[:, :, None, None, None].unbind(1)

    padded = F.pad(light, (2, 2, 2, 2), mode="replicate")

    up = [padded[:, :, i : i + height] for i in range(5)]
    down = a * up[2] + b * (up[1] + up[3]) + c * (up[0] + up[4])
    left = [down[..., j : j + width] for j in range(5)]
    return a * left[2] + b * (left[1] + left[3]) + c * (left[0] + left[4])


def unprocess(srgb: Tensor, camera: Unprocessing, white: float, band: int = BAND) -> Tensor:
    """Convert sRGB to packed RAW.

    Args:
        srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.
        camera: the settings of the pass.
        white: the value to clip at.
        band: pixels that a CPU works on at a time.

    Returns:
        float32 ``(B, 4, H/2, W/2)``.
    """
    batch, _, height, width = srgb.shape
    camera = Unprocessing(*move_together(camera, srgb.device))
    raw = torch.empty(batch, 4, height // 2, width // 2, device=srgb.device, dtype=torch.float32)
    pictures, rows = batch, height
    if srgb.device.type == "cpu":
        pictures, rows = 1, max(2, band // max(width, 1) // 2 * 2)

    for first in range(0, batch, pictures):
        group = slice(first, first + pictures)
        settings = camera._replace(
            curves=camera.curves[group],
            colour=camera.colour[group],
            frame=camera.frame[group],
            taps=camera.taps[group],
        )
        for top in range(0, height, rows):
            cells = slice(top // 2, (top + rows) // 2)
            light = _linear_light(srgb[group], settings, top, min(top + rows, height))
            _develop(light, settings, top, raw[group, :, cells])

    return raw.clamp_(max=white)


def look_up(table: Tensor, x: Tensor) -> Tensor:
    """Interpolate ``table`` ``(N, N, N, 4)`` trilinearly at colours ``x`` ``(B, 3, H, W)``: ``(B, 4, H, W)``."""
    batch, _, height, width = x.shape
    half = 127.5 if x.dtype == torch.uint8 else 0.5
    points = (x / half - 1.0).permute(0, 2, 3, 1).reshape(1, batch, height, width, 3)

    cube = table.permute(3, 0, 1, 2)[None]
    values = F.grid_sample(cube, points.to(table), padding_mode="border", align_corners=True)
    return values[0].transpose(0, 1)


def apply_curves(curves: Tensor, x: Tensor) -> Tensor:
    """Map each picture of ``x`` ``(B, C, H, W)`` by its own curve of ``curves`` ``(B, T)``, interpolated linearly.

    Curves of 256 entries have one for each code of uint8, and nothing is interpolated. Floats are held to [0, 1].
    """
    if x.dtype == torch.uint8 and curves.shape[1] == 256:
        return _take(curves, x.int())

    unit = x / 255.0 if x.dtype == torch.uint8 else x.clamp(0.0, 1.0)
    position = unit * (curves.shape[1] - 1)
    left = position.int().clamp_max(curves.shape[1] - 2)
    return torch.lerp(_take(curves, left), _take(curves, left + 1), position - left)


def _take(curves: Tensor, index: Tensor) -> Tensor:
    """Take the entries ``index`` ``(B, C, H, W)`` of each picture's curve."""
    return curves.gather(1, index.flatten(1).long()).reshape(index.shape)


class Display(NamedTuple):
    """The settings of the way from camera colour to sRGB, float32; where they are is as for :class:`Unprocessing`.

    Args:
        table: ``(N, N, N, 4)`` sRGB over the cube of roots of x2, axes B, G, R; empty if the pictures have curves.
        curves: ``(B, T)`` sRGB code over the root of x2, one curve a picture for all of its channels; or empty.
        attention: of the same form as ``table``, a gain in the first of the four over the cube of x5; or empty.
        matrix: ``(B, 3, 3)`` x3 to x2.
        gains: ``(B, 4)`` of R, G and B, then the least of them.
        frame, shading: as of :class:`Unprocessing`.
    """

    table: Tensor
    curves: Tensor
    attention: Tensor
    matrix: Tensor
    gains: Tensor
    frame: Tensor
    shading: Tensor


def site_weights(cfa: CFA) -> Tensor:
    """Lay out the stencils of :data:`rawaug.bayer.STENCILS` as weights of six sums around a site.

    They are the site's own value and the sums of its neighbours along the row, along the column, along the diagonals,
    and of those two sites away along row and column: stencils are symmetric.

    Returns:
        Weights ``(2, 2, 2, 3, 6)`` by stencil, row and column of the cell, colour and sum.
    """
    weights = []
    for method in STENCILS:
        stencils, kinds = demosaicing_stencils(cfa, method)
        edge = 2 - stencils.shape[-1] // 2
        around = F.pad(stencils, (edge, edge, edge, edge))

        measured = torch.eye(6)[:1]  # a site that has the colour keeps its own value
        sums = torch.stack([around[:, i, j] for i, j in ((2, 2), (2, 1), (1, 2), (1, 1), (2, 0), (0, 2))], dim=1)
        weights.append(torch.cat([measured, sums])[torch.tensor(kinds)].permute(1, 2, 0, 3))
    return torch.stack(weights)


def render(linear: Tensor, display: Display) -> Tensor:
    """Develop camera colour x5 ``(B, 3, H, W)``, float32, to sRGB in [0, 1]; the pass is differentiable."""
    mask = fall_off(display, 0, *linear.shape[-2:])
    x = linear
    if mask is not None:
        x = linear / mask

    if display.attention.numel():
        x = x * look_up(display.attention, x)[:, :1]

    # A saturated sensor is balanced only at its least gain. As in RAW developers, all channels are clipped there, since
    # highlights would otherwise turn magenta.
    gains, white = display.gains[:, :3, None, None], display.gains[:, 3:, None, None]
    x = torch.minimum(x * gains, white)

    # The root spreads the dark tones, where an inverse tone curve is steep, over more of the table's nodes.
    root = torch.einsum("bij,bjhw->bihw", display.matrix, x).clamp(1e-12, 1.0).sqrt()
    if display.curves.numel():
        return apply_curves(display.curves, root)
    return look_up(display.table, root)[:, :3].clamp(0.0, 1.0)


def _linear_light(srgb: Tensor, camera: Unprocessing, top: int, bottom: int) -> Tensor:
    """Compute rows ``top`` to ``bottom`` of x2, blurred."""
    margin = 2 if camera.taps.numel() else 0
    first = max(top - margin, 0)
    x = srgb[:, :, first : bottom + margin]

    if camera.curves.numel():
        x2 = apply_curves(camera.curves, x)
    else:
        x2 = look_up(camera.table, x)[:, :3]
    if margin:
        x2 = blur(x2, camera.taps)
    return x2[:, :, top - first : bottom - first]


def _develop(x2: Tensor, camera: Unprocessing, top: int, raw: Tensor) -> None:
    """Convert rows of linear light from ``top`` on, and write them to ``raw``."""
    mask = fall_off(camera, top, *x2.shape[-2:])

    for plane, (i, j, channel) in enumerate(camera.sites):
        here = x2[..., i::2, j::2]
        shade = mask
        if mask is not None:
            shade = mask[..., i::2, j::2]
        if camera.attention.numel():
            x4 = _channels(here, camera, slice(0, 3), shade)
            raw[:, plane] = x4[:, channel] * look_up(camera.attention, x4)[:, 0]
        else:
            raw[:, plane] = _channels(here, camera, slice(channel, channel + 1), shade)[:, 0]


def _channels(x2: Tensor, camera: Unprocessing, channels: slice, mask: Tensor | None) -> Tensor:
    """Compute some channels of x4 times the mask."""
    rows, mean = camera.colour[:, :3], camera.colour[:, 3:4]
    floor, rise = camera.colour[:, 4], camera.colour[:, 5]

    m = torch.einsum("bck,bkhw->bchw", mean, x2).sub_(camera.knee).div_(1.0 - camera.knee).clamp_(0.0, 1.0).square_()
    factor = torch.addcmul(floor[:, channels, None, None], m, rise[:, channels, None, None])
    x4 = torch.einsum("bck,bkhw->bchw", rows[:, channels], x2).mul_(factor)
    if mask is not None:
        x4.mul_(mask)
    return x4


def fall_off(camera: Unprocessing | Display, top: int, height: int, width: int) -> Tensor | None:
    """Compute the mask ``(B, 1, H, W)`` of ``height`` rows of ``width`` pixels from ``top`` on; None without shading.

    ``camera`` holds the frames of the pictures and the exponents.
    """
    if not camera.shading.numel():
        return None

    i = torch.arange(top, top + height, device=camera.frame.device)[:, None]
    j = torch.arange(width, device=camera.frame.device)
    y_start, x_start, y_down, x_down, y_right, x_right = camera.frame[..., None, None].unbind(1)
    y = y_start + i * y_down + j * y_right
    x = x_start + i * x_down + j * x_right

    a, b, c = camera.shading
    return torch.exp2(-(a * y * y + (b * y + c * x) * x))[:, None]


def philox(key: int, counters: Tensor) -> Tensor:
    """Run Philox4x32-10 on counters ``(n,)`` below 2^32 under a key below 2^64: words ``(4, n)`` below 2^32, int64."""
    zero = torch.zeros_like(counters)
    a, b, c, d = counters, zero, zero, zero
    low, high = key & _LOW, key >> 32

    for _ in range(ROUNDS):
        high_a, low_a = _product(a, MULTIPLIERS[0])
        high_c, low_c = _product(c, MULTIPLIERS[1])
        a, b, c, d = high_c ^ b ^ low, low_c, high_a ^ d ^ high, low_a
        low, high = (low + INCREMENTS[0]) & _LOW, (high + INCREMENTS[1]) & _LOW
    return torch.stack([a, b, c, d])


def normals(key: int, height: int, width: int) -> Tensor:
    """Draw standard normals for the planes of a packed picture, float32 ``(4, H, W)``; cells are counted row by row."""
    w = philox(key, torch.arange(height * width))
    radius = (w[0::2].float() + 0.5).mul_(2.0**-32).log_().mul_(-2.0).sqrt_()

    signed = torch.where(w[1::2] < 2**31, w[1::2], w[1::2] - 2**32)
    angle = signed.double().mul_(2.0 * math.pi / 2**32)
    pairs = torch.stack([radius * angle.cos().float(), radius * angle.sin().float()], dim=1)
    return pairs.reshape(4, height, width)


def _product(x: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Compute the high and low 32 bits of a product, by halves, as int64 has no room for all of its 64 bits."""
    upper, lower = (x >> 16) * factor, (x & 0xFFFF) * factor
    high = (upper + (lower >> 16)) >> 16
    return high, ((upper << 16) + lower) & _LOW
