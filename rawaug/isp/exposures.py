"""Exposures of a scene, merged or scaled in RAW.

Pictures k of one scene, of exposures t_k (2^EV) and RAW y_k = t_k E, give at each pixel the RAW E at 0 EV

    E = sum_k m_k y_k / sum_k m_k t_k,        m_k = clip((0.95 - max_c x_k) / 0.1, 0, 1),

the maximum-likelihood estimate under Poisson statistics from the readings that m_k keeps: a pixel whose brightest sRGB
channel comes close to white may be clipped. Where this holds for every picture, the shortest exposure alone decides
(after Debevec and Malik, SIGGRAPH 1997).

On the way to sRGB, RAW is scaled by 2^EV, and by f(L) / L if its largest linear channel L exceeds middle grey a:

    f(L) = a + (1 - a) g((L - a) / (1 - a)),        g(u) = u (1 + u / v^2) / (1 + u),

with g from Reinhard et al., SIGGRAPH 2002, eq. 4, and v such that f takes the scene's white to 1. RAW has all three
colours at every pixel here (x5). Merging and scaling commute with the mosaic, but no detail is lost to demosaicing.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.isp.alignment import Motion, find_contradictions, move_back
from rawaug.isp.config import ISPParams, ISPResult
from rawaug.isp.functional import as_display_referred, inverse_gains
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import WhiteBalance

_MIDDLE_GREY = 0.18
"""The linear light above which highlights are compressed."""

_CLIPPED, _RAMP = 0.95, 0.1
_LAST_RESORT = 1e-4
"""Minimum weight of the shortest exposure, which decides if no other does."""

_NOTHING_ELSE = 1e-8
"""Minimum weight of the reference, which decides where no other exposure saw the scene."""

_SCENE_WHITE = 0.999
"""Minimum share of pixels that are not clipped."""


def confidence(srgb: Tensor) -> Tensor:
    """Compute m ``(B, 1, H, W)``: how certain it is that a pixel of sRGB ``(B, 3, H, W)`` in [0, 1] is not clipped."""
    return ((_CLIPPED - srgb.amax(dim=1, keepdim=True)) / _RAMP).clamp(0.0, 1.0)


@torch.no_grad()
def merge_exposures(
    isp: DictionaryISP,
    pictures: Sequence[Tensor],
    ev: Sequence[float],
    motions: Sequence[Motion] | None = None,
) -> ISPResult:
    """Merge pictures of a scene into its RAW at 0 EV; one picture alone is divided by its exposure.

    All pictures share the setting that the ISP chooses for the one nearest to 0 EV, the reference.

    Args:
        isp: the camera.
        pictures: sRGB ``(B, 3, H, W)`` each, uint8 or float in [0, 1].
        ev: exposure of each picture in stops.
        motions: how each single picture moved against the reference, by
            :func:`rawaug.isp.alignment.find_motion`. The pictures are brought to the reference's pixels in RAW, and
            places where one contradicts the reference do not count. Without motions the pictures are aligned.

    Returns:
        The RAW ``(B, 3, H, W)`` as ``image``, with all colours at every pixel, and the setting. RAW exceeds 1 where the
        scene is brighter than white at 0 EV.

    Raises:
        ValueError: if exposures or shapes do not fit the pictures, or two exposures are equal.
    """
    _require_bracket(pictures, ev)

    nearest = reference_exposure(ev)
    reference = as_display_referred(pictures[nearest])
    params = isp.choose(reference)
    reference_weight = confidence(reference)
    reference_light = _linear_reverse(isp, reference, params) / 2.0 ** ev[nearest]

    total = exposure = torch.zeros(())
    for number, (picture, stops) in enumerate(zip(pictures, ev, strict=True)):
        x = as_display_referred(picture)
        weight = confidence(x)
        if stops == min(ev):
            weight = weight.clamp_min(_LAST_RESORT)
        raw = _linear_reverse(isp, x, params)

        if motions is not None and number != nearest:
            raw, weight = move_back(raw, motions[number]), move_back(weight, motions[number]).clamp(0.0, 1.0)
            clear = weight * reference_weight
            weight = weight * (1.0 - find_contradictions(reference_light, raw / 2.0**stops, clear))
        if motions is not None and number == nearest:
            weight = weight.clamp_min(_NOTHING_ELSE)

        total = total + weight * raw
        exposure = exposure + weight * 2.0**stops

    return ISPResult(total / exposure, params)


def reference_exposure(ev: Sequence[float]) -> int:
    """Return the number of the picture nearest to 0 EV, whose pixels and setting the merged picture has."""
    return min(range(len(ev)), key=lambda number: abs(ev[number]))


@torch.no_grad()
def render_exposure(isp: DictionaryISP, raw: Tensor, params: ISPParams, ev: float = 0.0) -> Tensor:
    """Develop the RAW of :func:`merge_exposures` at another exposure, with highlights compressed.

    Args:
        isp: the camera that merged it.
        raw: ``(B, 3, H, W)``.
        params: the setting that came with it.
        ev: exposure in stops; RAW is multiplied by ``2**ev``.

    Returns:
        sRGB ``(B, 3, H, W)`` in [0, 1].
    """
    raw = raw * 2.0**ev
    light = linear_light(isp, raw, params).amax(dim=1, keepdim=True)

    compressed = raw * _compress(light) / light.clamp_min(_MIDDLE_GREY)
    return isp.stages.forward(compressed, params).clamp(0.0, 1.0)


@torch.no_grad()
def linear_light(isp: DictionaryISP, raw: Tensor, params: ISPParams) -> Tensor:
    """Convert RAW ``(B, 3, H, W)`` to linear sRGB of the same shape, neither compressed nor clipped."""
    light = raw
    for stage in reversed(isp.stages.ordered):
        if stage.makes > 2:
            light = stage.forward(light, params)
    return light


def _linear_reverse(isp: DictionaryISP, x: Tensor, params: ISPParams) -> Tensor:
    """Compute x5 from x with a plain division by the gains, as highlight-safe gains are not linear in the scene."""
    for stage in isp.stages.ordered:
        if isinstance(stage, WhiteBalance):
            x = inverse_gains(x, params.gains, knee=None)
        else:
            x = stage.reverse(x, params)
    return x


def _compress(light: Tensor) -> Tensor:
    """Compute f(L), held to at least a, so that its ratio to ``max(L, a)`` is 1 in the shadows."""
    flat = light.flatten(1)
    rank = max(round(_SCENE_WHITE * flat.shape[1]), 1)
    brightest = flat.kthvalue(rank, dim=1).values.clamp_min(1.0)
    white = ((brightest - _MIDDLE_GREY) / (1.0 - _MIDDLE_GREY)).reshape(-1, 1, 1, 1)

    u = (light.clamp_min(_MIDDLE_GREY) - _MIDDLE_GREY) / (1.0 - _MIDDLE_GREY)
    return _MIDDLE_GREY + (1.0 - _MIDDLE_GREY) * u * (1.0 + u / white**2) / (1.0 + u)


def _require_bracket(pictures: Sequence[Tensor], ev: Sequence[float]) -> None:
    if not pictures or len(pictures) != len(ev):
        raise ValueError(f"one exposure for each picture is needed, got {len(ev)} for {len(pictures)}")
    if len(set(ev)) != len(ev):
        exposures = " ".join(f"{stops:+g}" for stops in ev)
        raise ValueError(f"exposures must differ, got {exposures} EV")

    shapes = dict.fromkeys(tuple(picture.shape) for picture in pictures)
    if len(shapes) > 1:
        raise ValueError(f"pictures must have one shape, got {' and '.join(map(str, shapes))}")
