r"""What is known of a shot is fused with what the encoders choose, not put in its place.

Of a picture, let ``t = log(g / C 1)`` be the gains of grey. The choice gives ``m = t + e``, and a file's white balance
``z = log wb + k = t + n``, with ``k`` the digital gain and tint that go with the atoms. With the covariances ``S_e``
and ``S_n`` of these errors, which a fit measures, the estimate and its covariance are

    t = m + K (z - m),    K = S_e (S_e + S_n)^-1,    P = S_e - K S_e

If ``S_n`` is zero, the file decides; if it is infinite, the choice stays. Both guess the digital gain, which no file
states, and err alike, so that only one guess may count: unless the file's is clearly better, ``S_n`` is infinite along
(1, 1, 1), and z says the ratios alone. Constants are a choice with a large ``S_e``: of them, and where nothing was
measured, it is 1, and the file decides. Atoms keep the weights that the encoders gave them, times
``exp(-d^2 / 2 spread^2)`` for the distance d of their light to that of the file. A known digital gain, the green of
``t``, and RAW readings are further observations ``t_o`` of the same state, ``t <- t + P (P + S_o)^-1 (t_o - t)``.

RAW readings ``y_k`` of a channel give its gain by least squares, ``1 / g = sum w x5 y / sum w x5^2`` with ``x5`` made
under gain 1. They are weighted by ``w = 1 / (y + 0.01)`` for shot noise and reweighted (Cauchy) against readings that
lie on edges. If tone is a mixture of curves and the camera a mixture of cameras, readings choose these as well, in
turn: given the gains, ``g_c y = sum_k v_k (C T_k(x))_c`` is linear in the weights v, and ``sum_n w_n (C_n T(x))_c`` in
w.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.isp.config import ISPInfo, ISPParams
from rawaug.isp.dictionary import CameraDictionary, ColourDictionary, nearest_in_hull
from rawaug.isp.tone import ToneDictionary
from rawaug.kernels.reference import apply_curves
from rawaug.registry import suggest

Tone = str | Mapping[str, float] | Tensor
"""A tone curve by name, a mixture of curves (shares by name), or weights ``(K,)`` or ``(B, K)`` of all of them."""

CLIPPED = 0.98
_SHADOW = 0.01
"""The share of read noise, which is added to a reading that serves as a variance."""
_ROUNDS = 4
DIGITAL_SLACK = 1e-6
"""Variance of the logarithm of a digital gain that nothing was measured of, beside 1 of what is chosen."""
_LEAST_DEVIATION = 1e-3
"""Least deviation of a reading, in units of the root of itself; the residuals of one or two readings say nothing."""
_PULL = 1e-4
"""Strength of the pull of weights towards the typical ones, as a share of the readings' mean square."""


def log_grey(params: ISPParams) -> Tensor:
    """Compute ``log(g / C 1)`` ``(B, 3)``, the logarithm of the gains of grey, of the settings of B pictures."""
    return (params.gains / params.matrix.sum(2).clamp_min(1e-3)).log()


def with_grey(colour: ColourDictionary, params: ISPParams, colour_weights: Tensor, grey: Tensor) -> ISPParams:
    """Change the weights ``(B, N)`` of the colour atoms, and the logarithms ``(B, 3)`` of the gains of grey.

    Args:
        colour: the colour atoms.
        params: the settings of B pictures.
        colour_weights: the new weights.
        grey: the new logarithms.
    """
    matrix = colour.combine(colour_weights)
    gains = grey.exp() * matrix.sum(2).clamp_min(1e-3)
    return params._replace(colour_weights=colour_weights, matrix=matrix, gains=gains)


def fuse_stated(
    colour: ColourDictionary,
    info: ISPInfo,
    params: ISPParams,
    white_balance: Tensor | tuple[float, ...] | None,
    digital_gain: Tensor | float | None,
) -> tuple[ISPParams, Tensor]:
    """Fuse the gains and the colour atoms that were chosen for B pictures with what the camera states.

    Args:
        colour: the colour atoms.
        info: the record of the ISP, whose ``gain_errors`` are the covariances S_e and S_n that its fit has measured.
            Without them it believes the file, but for the digital gain if that is stated as well.
        params: the settings that were chosen.
        white_balance, digital_gain: as for :meth:`rawaug.DictionaryISP.reverse`.

    Returns:
        The settings, and the covariance P of their gains of grey, float64 ``(B, 3, 3)``.

    Raises:
        ValueError: if a multiplier is not positive, or the shapes are for another number of pictures.
    """
    batch = len(params.gains)
    chosen, stated = torch.eye(3).double(), torch.full((3, 3), DIGITAL_SLACK).double()
    if "gain_errors" in info:
        chosen, stated = torch.tensor(info["gain_errors"], dtype=torch.float64)
    chosen, stated = chosen.to(params.gains.device), stated.to(params.gains.device)
    covariance = chosen.expand(batch, 3, 3)

    if white_balance is not None:
        balance = torch.as_tensor(white_balance, dtype=params.gains.dtype, device=params.gains.device)
        if balance.shape not in ((3,), (1, 3), (batch, 3)):
            raise ValueError(f"white_balance must be (3,) or ({batch}, 3), got {tuple(balance.shape)}")
        _require_positive("white_balance", balance)

        balance = (balance / balance[..., 1:2]).expand_as(params.gains)
        weights = colour.weights_for(balance, params.colour_weights)
        grey = log_grey(params)
        seen = balance.log() + weights @ colour.neutral

        share = torch.linalg.solve(chosen + stated, chosen, left=False)
        grey = grey + ((seen - grey).double() @ share.T).to(grey)
        covariance = (chosen - share @ chosen).expand(batch, 3, 3)
        params = with_grey(colour, params, weights, grey)

    if digital_gain is not None:
        digital = torch.as_tensor(digital_gain, dtype=params.gains.dtype, device=params.gains.device).reshape(-1, 1)
        if len(digital) not in (1, batch):
            raise ValueError(f"digital_gain must be a number or ({batch},), got {len(digital)}")
        _require_positive("digital_gain", digital)

        grey = log_grey(params)
        share = covariance[:, :, 1] / covariance[:, 1:2, 1]
        grey = grey + (share * (digital.log() - grey[:, 1:2])).to(grey)
        covariance = covariance - share[:, :, None] * covariance[:, 1:2]
        params = with_grey(colour, params, params.colour_weights, grey)

    return params, covariance


def _require_positive(name: str, value: Tensor) -> None:
    if not (value.isfinite() & (value > 0)).all():
        raise ValueError(f"{name} must be positive, got {value.flatten().tolist()}")


def weigh_tones(tone: Tone, names: Sequence[str], like: Tensor) -> Tensor:
    """Weigh K tone curves; the weights are divided by their sum.

    Args:
        tone: a curve by name, shares by name, or weights ``(K,)`` or ``(B, K)``.
        names: names of the curves, if they have any.
        like: ``(B, K)``, the weights to replace.

    Returns:
        Weights of the shape and type of ``like``.

    Raises:
        ValueError: if there is no such curve, a share is negative, or the weights are for another number of pictures.
    """
    batch, count = like.shape
    if isinstance(tone, Tensor):
        weights = tone.to(like)
    else:
        shares = {tone: 1.0} if isinstance(tone, str) else tone
        weights = like.new_zeros(count)
        for name, share in shares.items():
            if name not in names:
                raise ValueError(f"tone {name!r} is unknown; use one of {', '.join(names)}{suggest(name, names)}")
            weights[names.index(name)] = share

    if weights.shape not in ((count,), (1, count), (batch, count)):
        raise ValueError(f"tone must be ({count},) or ({batch}, {count}), got {tuple(weights.shape)}")

    total = weights.sum(dim=-1, keepdim=True)
    if not (weights >= 0).all() or not ((total > 0) & total.isfinite()).all():
        raise ValueError("tone: shares must not be negative, and one must be positive")
    return (weights / total).expand(batch, count)


# -- readings ----------------------------------------------------------------------------------------------------------


def locate_readings(
    raw_samples: Tensor, x: Tensor, coordinates: Tensor, cfa: CFA
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Look up what the pictures have where RAW was read.

    Args:
        raw_samples: ``(B, K, 3)`` of row, column and RAW value.
        x: sRGB as float ``(B, 3, H, W)``.
        coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame.
        cfa: the pattern of the RAW.

    Returns:
        sRGB ``(B, 3, 1, K)`` and coordinates ``(B, 2, 1, K)`` there; 1 in the channel of the reading, ``(B, 3, K)``;
        and the readings, ``(B, K)``.

    Raises:
        ValueError: if a reading is NaN or lies outside the picture.
    """
    if raw_samples.ndim != 3 or len(raw_samples) != len(x) or raw_samples.shape[2] != 3 or not raw_samples.shape[1]:
        raise ValueError(f"raw_samples are ({len(x)}, K, 3) of (row, column, value), got {tuple(raw_samples.shape)}")
    if not raw_samples.isfinite().all():
        raise ValueError("raw_samples: a value is NaN; remove such readings")

    sides = torch.tensor(x.shape[-2:], device=raw_samples.device)
    if ((raw_samples[..., :2] < 0) | (raw_samples[..., :2] >= sides)).any():
        raise ValueError(f"raw_samples: a row or column is outside the picture, {x.shape[-2]} x {x.shape[-1]}")

    rows, columns, value = raw_samples[..., 0].long(), raw_samples[..., 1].long(), raw_samples[..., 2]
    batch = torch.arange(len(x), device=x.device)[:, None]
    pixels = x[batch, :, rows, columns].transpose(1, 2)[:, :, None]
    places = coordinates.expand(len(x), -1, -1, -1)[batch, :, rows, columns].transpose(1, 2)[:, :, None]
    channel = torch.tensor(cfa.channels, device=x.device)[rows % 2, columns % 2]
    site = F.one_hot(channel, 3).transpose(1, 2).to(x)
    return pixels, places, site, value


def solve_gains(x5: Tensor, site: Tensor, value: Tensor, params: ISPParams) -> tuple[ISPParams, Tensor]:
    """Solve for the gains of K readings of each picture.

    Args:
        x5: the colours there under gains of 1, ``(B, 3, K)``.
        site: 1 in the channel of the reading, ``(B, 3, K)``.
        value: the readings, ``(B, K)``; clipped ones do not count.
        params: the settings, whose gains stay where no reading tells them.

    Returns:
        The settings, and the precision of the logarithms of their gains, float64 ``(B, 3)``.
    """
    y = value[:, None].expand_as(x5)
    usable = site * (y < CLIPPED)
    weight = usable / (y.clamp_min(0.0) + _SHADOW)
    inverse = torch.ones_like(params.gains)
    for _ in range(_ROUNDS):
        inverse = (weight * x5 * y).sum(2) / (weight * x5 * x5).sum(2).clamp_min(1e-12)
        residual = (y - inverse[..., None] * x5).abs() / (y.clamp_min(0.0) + _SHADOW).sqrt()
        typical = residual.masked_fill(usable == 0, torch.nan).nanmedian(dim=2, keepdim=True).values.clamp_min(1e-6)
        weight = usable / (y.clamp_min(0.0) + _SHADOW) / (1.0 + (residual / (2.0 * typical)) ** 2)

    solvable = (usable.sum(2) > 0) & (inverse > 0)
    gains = torch.where(solvable, 1.0 / inverse.clamp_min(1e-6), params.gains)

    # 1.5 median residuals are a deviation, with which least squares has the variance s^2 / sum w x5^2
    deviation = (1.5 * typical[..., 0]).nan_to_num(1.0).clamp_min(_LEAST_DEVIATION)
    precision = (inverse / deviation).square() * (weight * x5 * x5).sum(2)
    return params._replace(gains=gains), torch.where(solvable, precision, 0.0).double()


def fit_mixtures(
    cameras: CameraDictionary, tones: ToneDictionary, pixels: Tensor, site: Tensor, value: Tensor, params: ISPParams
) -> ISPParams:
    """Fit the mixture of curves, then that of cameras, to K readings of each picture, under its gains.

    Args:
        cameras, tones: the atoms.
        pixels: sRGB at the readings, ``(B, 3, 1, K)``.
        site, value: as for :func:`solve_gains`.
        params: the settings; the weights and the matrix change.
    """
    target = value * torch.einsum("bck,bc->bk", site, params.gains)
    weight = ((value < CLIPPED) / (value.clamp_min(0.0) + _SHADOW)).sqrt()
    rows = torch.einsum("bck,bcd->bkd", site, params.matrix)
    linear = torch.stack([apply_curves(curve.expand(len(pixels), -1), pixels) for curve in tones.curves], dim=1)
    readings = torch.einsum("bkd,bndk->bnk", rows, linear[:, :, :, 0])
    tone_weights = _nearest(weight * target, weight[:, None] * readings, tones.typical)

    x2 = apply_curves(tones.combine(tone_weights), pixels)[:, :, 0]
    readings = torch.einsum("bck,ncd,bdk->bnk", site, cameras.atoms(), x2)
    colour_weights = _nearest(weight * target, weight[:, None] * readings, cameras.typical)
    matrix = cameras.combine(colour_weights)
    return params._replace(tone_weights=tone_weights, colour_weights=colour_weights, matrix=matrix)


def _nearest(target: Tensor, readings: Tensor, typical: Tensor) -> Tensor:
    """Find weights ``(B, N)`` whose mixture of ``readings`` ``(B, N, K)`` is nearest to ``target`` ``(B, K)``."""
    rows = []
    for row, atoms in zip(target.double(), readings.double(), strict=True):
        # A mixture that the readings do not determine falls back on the typical weights.
        pull = (_PULL * atoms.square().mean() * atoms.shape[1]).sqrt() * torch.eye(len(atoms)).to(atoms)
        point = torch.cat([row, typical.to(atoms) @ pull])

        weights, _ = nearest_in_hull(point[None], torch.cat([atoms, pull], dim=1))
        rows.append(weights[0])

    return torch.stack(rows).to(target.dtype)


def fuse_readings(
    reverse: Callable[[ISPParams], Tensor],
    colour: ColourDictionary,
    tones: ToneDictionary | None,
    chosen_weights: Tensor,
    params: ISPParams,
    covariance: Tensor,
    pixels: Tensor,
    site: Tensor,
    value: Tensor,
) -> ISPParams:
    """Fuse the gains of settings with K RAW readings of each picture, whose light weighs the colour atoms.

    Args:
        reverse: computes x5 at the readings, ``(B, 3, K)``, of settings.
        colour, tones: the atoms; published cameras and their curves are fitted to the readings as well.
        chosen_weights: the weights ``(B, N)`` of the colour atoms before anything was known of the light.
        params, covariance: what :func:`fuse_stated` gives.
        pixels: sRGB at the readings, ``(B, 3, 1, K)``.
        site, value: as for :func:`solve_gains`.
    """

    def solve(setting: ISPParams) -> tuple[ISPParams, Tensor]:
        x5 = reverse(setting._replace(gains=torch.ones_like(setting.gains)))
        return solve_gains(x5, site, value, setting)

    solved, precision = solve(params)
    if tones is not None and isinstance(colour, CameraDictionary):
        for _ in range(_ROUNDS):
            solved = fit_mixtures(colour, tones, pixels, site, value, solved)
            solved, precision = solve(solved)
    else:
        light = (log_grey(solved) - solved.colour_weights @ colour.neutral).exp()
        weights = colour.weights_for(light, chosen_weights)
        solved, precision = solve(with_grey(colour, solved, weights, log_grey(solved)))

    grey = observe_grey(log_grey(params), covariance, log_grey(solved), precision)
    return with_grey(colour, solved, solved.colour_weights, grey)


def observe_grey(expected: Tensor, covariance: Tensor, observed: Tensor, precision: Tensor) -> Tensor:
    """Fuse expected logarithms of the gains of grey with observed ones, ``t <- t + P (P + S_o)^-1 (t_o - t)``.

    Args:
        expected: ``(B, 3)``.
        covariance: P, their covariance, float64 ``(B, 3, 3)``.
        observed: ``(B, 3)``.
        precision: one over their variances, float64 ``(B, 3)``; 0 for a channel without any reading.
    """
    information = torch.diag_embed(precision)
    share = torch.linalg.solve(torch.eye(3).to(covariance) + covariance @ information, covariance) @ information
    return expected + (share @ (observed - expected).double()[:, :, None])[:, :, 0].to(expected)
