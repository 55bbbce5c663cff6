r"""Known data of a shot that replace the ISP's guess: the camera's gains, or a few RAW readings.

Grey ``(1, 1, 1)`` becomes ``C 1 / g``, and the file says that it is ``1 / (wb d)``; hence ``g = wb d (C 1)``. Readings
``y_k`` of a channel give its gain by least squares, ``1 / g = sum w x5 y / sum w x5^2`` with ``x5`` made under gain 1,
weighted by ``w = 1 / (y + 0.01)`` for shot noise and reweighted (Cauchy) against readings that lie on edges.

Where tone is a mixture of curves, and the camera one of cameras, readings choose these as well: given the gains,
``g_c y = sum_k v_k (C T_k(x))_c`` is linear in the weights v, and ``sum_n w_n (C_n T(x))_c`` in w. Gains, v and w are
solved for in turn.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import CameraDictionary, nearest_in_hull
from rawaug.isp.staged import StagedISP
from rawaug.isp.tone import ToneDictionary
from rawaug.kernels.reference import through_curves

CLIPPED = 0.98
SHADOW = 0.01
"""Added to a reading used as a variance: the share of read noise."""
ROUNDS = 4
PULL = 1e-4
"""Of the typical weights, against the readings' mean square."""


def with_white_balance(
    isp: StagedISP,
    params: ISPParams,
    white_balance: Tensor | tuple[float, ...] | None,
    digital_gain: Tensor | float | None,
) -> ISPParams:
    """Put the camera's own gains, and the colour atoms of such light, in place of the chosen ones."""
    batch = len(params.gains)
    if white_balance is not None:
        balance = torch.as_tensor(white_balance, dtype=params.gains.dtype, device=params.gains.device)
        if balance.shape not in ((3,), (1, 3), (batch, 3)):
            raise ValueError(f"white_balance must be (3,) or ({batch}, 3), got {tuple(balance.shape)}")
        _require_factor("white_balance", balance)
        balance = (balance / balance[..., 1:2]).expand_as(params.gains)
        weights = isp.colour.weights_for(balance)
        matrix, gains = isp.colour.combine(weights), isp.colour.gains_for(balance, weights)
        params = params._replace(colour_weights=weights, matrix=matrix, gains=gains)
    if digital_gain is not None:
        digital = torch.as_tensor(digital_gain, dtype=params.gains.dtype, device=params.gains.device).reshape(-1, 1)
        if len(digital) not in (1, batch):
            raise ValueError(f"digital_gain must be a number or ({batch},), got {len(digital)}")
        _require_factor("digital_gain", digital)
        own = params.gains[:, 1:2] / params.matrix[:, 1:2].sum(2)
        params = params._replace(gains=params.gains / own * digital)
    return params


def _require_factor(name: str, value: Tensor) -> None:
    if not (value.isfinite() & (value > 0)).all():
        raise ValueError(f"{name} must be positive, got {value.flatten().tolist()}")


def with_raw_samples(isp: StagedISP, x: Tensor, params: ISPParams, raw_samples: Tensor, place: Tensor) -> ISPParams:
    """Gains from RAW readings, then the colour atoms of that light, and the gains again; clipped ones do not count."""
    _require_places(raw_samples, x)
    rows, columns = raw_samples[..., 0].long(), raw_samples[..., 1].long()
    batch = torch.arange(len(x), device=x.device)[:, None]
    pixels = x[batch, :, rows, columns].transpose(1, 2)[:, :, None]
    where = place.expand(len(x), -1, -1, -1)[batch, :, rows, columns].transpose(1, 2)[:, :, None]
    channel = torch.tensor(isp.cfa.channels, device=x.device)[rows % 2, columns % 2]
    own = F.one_hot(channel, 3).transpose(1, 2).to(x)
    return with_readings(isp, pixels, where, own, raw_samples[..., 2], params)


def with_readings(
    isp: StagedISP, pixels: Tensor, where: Tensor, own: Tensor, value: Tensor, params: ISPParams
) -> ISPParams:
    """As :func:`with_raw_samples`, for pixels that are at hand."""
    params = _solve(isp, pixels, where, own, value, params)
    if isp.tone is not None and isinstance(isp.colour, CameraDictionary):
        for _ in range(ROUNDS):
            params = _solve(isp, pixels, where, own, value, _mixed(isp.colour, isp.tone, pixels, own, value, params))
        return params
    light = params.gains / params.matrix.sum(2) / (params.colour_weights @ isp.colour.neutral).exp()
    weights = isp.colour.weights_for(light)
    params = params._replace(colour_weights=weights, matrix=isp.colour.combine(weights))
    return _solve(isp, pixels, where, own, value, params)


def _mixed(
    cameras: CameraDictionary, tones: ToneDictionary, pixels: Tensor, own: Tensor, value: Tensor, params: ISPParams
) -> ISPParams:
    """The nearest mixture of curves, then of cameras, under the gains that ``params`` have."""
    target = value * torch.einsum("bck,bc->bk", own, params.gains)
    weight = ((value < CLIPPED) / (value.clamp_min(0.0) + SHADOW)).sqrt()
    seen = torch.einsum("bck,bcd->bkd", own, params.matrix)
    curved = torch.stack([through_curves(curve.expand(len(pixels), -1), pixels) for curve in tones.curves], dim=1)
    makes = torch.einsum("bkd,bndk->bnk", seen, curved[:, :, :, 0])
    tone_weights = _nearest(weight * target, weight[:, None] * makes, tones.typical)
    x2 = through_curves(tones.combine(tone_weights), pixels)[:, :, 0]
    makes = torch.einsum("bck,ncd,bdk->bnk", own, cameras.atoms(), x2)
    colour_weights = _nearest(weight * target, weight[:, None] * makes, cameras.typical)
    matrix = cameras.combine(colour_weights)
    return params._replace(tone_weights=tone_weights, colour_weights=colour_weights, matrix=matrix)


def _nearest(target: Tensor, makes: Tensor, typical: Tensor) -> Tensor:
    """Weights ``(B, N)`` whose mixture of ``makes`` ``(B, N, K)`` is nearest ``target`` ``(B, K)``."""
    rows = []
    for wanted, atoms in zip(target.double(), makes.double(), strict=True):
        pull = (PULL * atoms.square().mean() * atoms.shape[1]).sqrt() * torch.eye(len(atoms)).to(atoms)
        point = torch.cat([wanted, typical.to(atoms) @ pull])
        rows.append(nearest_in_hull(point[None], torch.cat([atoms, pull], dim=1))[0][0])
    return torch.stack(rows).to(target.dtype)


def _require_places(raw_samples: Tensor, x: Tensor) -> None:
    if raw_samples.ndim != 3 or len(raw_samples) != len(x) or raw_samples.shape[2] != 3 or not raw_samples.shape[1]:
        raise ValueError(
            f"raw_samples must be ({len(x)}, K, 3) of (row, column, value), got {tuple(raw_samples.shape)}"
        )
    if not raw_samples.isfinite().all():
        raise ValueError("raw_samples: a value is NaN; remove such readings")
    sides = torch.tensor(x.shape[-2:], device=raw_samples.device)
    if ((raw_samples[..., :2] < 0) | (raw_samples[..., :2] >= sides)).any():
        raise ValueError(f"raw_samples: a row or column is outside the picture, {x.shape[-2]} x {x.shape[-1]}")


def _solve(isp: StagedISP, pixels: Tensor, where: Tensor, own: Tensor, value: Tensor, params: ISPParams) -> ISPParams:
    unit = params._replace(gains=torch.ones_like(params.gains))
    x5 = isp.reverse_pixels(pixels, unit, where)[:, :, 0]
    y = value[:, None].expand_as(x5)
    usable = own * (y < CLIPPED)
    weight = usable / (y.clamp_min(0.0) + SHADOW)
    inverse = torch.ones_like(params.gains)
    for _ in range(ROUNDS):
        inverse = (weight * x5 * y).sum(2) / (weight * x5 * x5).sum(2).clamp_min(1e-12)
        residual = (y - inverse[..., None] * x5).abs() / (y.clamp_min(0.0) + SHADOW).sqrt()
        typical = residual.masked_fill(usable == 0, torch.nan).nanmedian(dim=2, keepdim=True).values.clamp_min(1e-6)
        weight = usable / (y.clamp_min(0.0) + SHADOW) / (1.0 + (residual / (2.0 * typical)) ** 2)
    known = (usable.sum(2) > 0) & (inverse > 0)
    return params._replace(gains=torch.where(known, 1.0 / inverse.clamp_min(1e-6), params.gains))
