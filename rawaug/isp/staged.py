r"""The parts of an ISP (stages, dictionaries, encoders that choose atoms), and settings from what a file states.

An encoder gives the weights of a dictionary's atoms, ``w = softmax(b + E(I))``, from the N images ``I`` that the atoms
make of one picture (Conde et al., AAAI 2022, "Parameter Dictionaries"). ``b`` is a learned constant, which decides
alone if there is no network ``E``.

What is known of a shot is fused with that choice, not put in its place. Of a picture, let ``t = log(g / C 1)`` be the
gains of grey. The choice gives ``m = t + e``, and a file's white balance ``z = log wb + k = t + n``, with ``k`` the
digital gain and tint that go with the atoms. With the covariances ``S_e`` and ``S_n`` of these errors, which a fit
measures, the estimate and its covariance are

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

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.isp.config import ISPConfig, ISPParams
from rawaug.isp.dictionary import CameraDictionary, ColourDictionary, GainDictionary, nearest_in_hull
from rawaug.isp.stages import STAGES, Stage
from rawaug.isp.tone import ToneCurve, ToneDictionary
from rawaug.kernels.reference import apply_curves
from rawaug.registry import suggest
from rawaug.seeding import derive_seed, initialise_from

S = TypeVar("S", bound=Stage)


THUMBNAIL = 48
"""Longest side of an encoder's input, in pixels."""
CLIPPED = 0.98
_SHADOW = 0.01
"""The share of read noise, which is added to a reading that serves as a variance."""
ROUNDS = 4
DIGITAL_SLACK = 1e-6
"""Variance of the logarithm of a digital gain that nothing was measured of, beside 1 of what is chosen."""
_LEAST_DEVIATION = 1e-3
"""Least deviation of a reading, in units of the root of itself; the residuals of one or two readings say nothing."""
_PULL = 1e-4
"""Strength of the pull of weights towards the typical ones, as a share of the readings' mean square."""


class Encoder(nn.Module):
    """A learned constant ``prior`` ``(N,)``, as logits, and convolutions if the encoder looks at the picture."""

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.prior = nn.Parameter(torch.zeros(atoms))
        self.layers: nn.Sequential | None = None

    @property
    def looks(self) -> bool:
        """Whether it has layers that look at the picture."""
        return self.layers is not None

    def add_layers(self, widths: tuple[int, int, int]) -> None:
        """Let the encoder look at the picture from now on, by three convolutions; untrained, they change no weight.

        ``widths`` are the numbers of their features.
        """
        atoms = len(self.prior)
        layers: list[nn.Module] = []
        channels = 3 * atoms
        for width in widths:
            layers += [nn.Conv2d(channels, width, 3, stride=2, padding=1), nn.ReLU()]
            channels = width

        head = nn.Linear(widths[-1], atoms)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), head).to(self.prior.device)

    def forward(self, images: Tensor) -> Tensor:
        """Weigh the N images ``(B, N, 3, h, w)`` that the atoms make: ``(B, N)`` on the simplex."""
        logits = self.prior.expand(len(images), -1)
        if self.layers is not None:
            logits = logits + self.layers(images.flatten(1, 2))
        return logits.softmax(dim=1)

    @torch.no_grad()
    def set_prior(self, weights: Tensor) -> None:
        """Set the constant so that it gives ``weights`` ``(N,)``; zeros become 1e-6."""
        self.prior.copy_(weights.clamp_min(1e-6).log())


class Encoders(nn.Module):
    """The encoders of one direction: one for the colour atoms, one for the gain atoms."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.colour = Encoder(config.colour_atoms)
        self.gain = Encoder(config.gain_atoms)


def thumbnail(image: Tensor) -> Tensor:
    """Average a picture ``(B, 3, H, W)`` down to at most :data:`THUMBNAIL` pixels a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return F.adaptive_avg_pool2d(image, size)


class StagedISP(nn.Module):
    """Stages, dictionaries and encoders; :class:`rawaug.isp.model.DictionaryISP` adds the choice of a setting."""

    def __init__(self, config: ISPConfig | None = None, seed: int = 0) -> None:
        super().__init__()
        self.info: dict[str, Any] = {}
        """The record of the fit, as plain values by name."""
        self.config = config or ISPConfig()
        """The parts that the ISP consists of; :meth:`configure` and :meth:`use_encoders` change them."""

        with initialise_from(seed):
            self.colour = ColourDictionary(self.config.colour_atoms)
            if self.config.cameras:
                self.colour = CameraDictionary(self.config.colour_atoms, self.config.cameras)
            self.gain = GainDictionary(self.config.gain_atoms)

            self.stages = nn.ModuleDict()
            for name in self.config.stages:
                stage = STAGES[name](self.config)
                self.stages[stage.name] = stage

            self.reverse_encoders, self.forward_encoders = Encoders(self.config), Encoders(self.config)
        self.use_encoders(self.config.encoders, seed)

    @property
    def cfa(self) -> CFA:
        """The pattern of the RAW that this ISP makes."""
        return CFA(self.config.cfa)

    @property
    def ordered_stages(self) -> list[Stage]:
        """The stages in reverse order."""
        return [cast(Stage, stage) for stage in self.stages.values()]

    def find(self, kind: type[S]) -> S | None:
        """The stage of this class, or None."""
        for stage in self.ordered_stages:
            if isinstance(stage, kind):
                return stage
        return None

    def configure(self, **changes: Any) -> None:
        """Change settings that need no new parameters: ``cfa``, ``knee``, or ``stages`` to fewer of them."""
        config = replace(self.config, **changes)
        for name in config.stages:
            if name not in self.stages:
                raise ValueError(f"stages: {name!r} is not in this ISP, which has {' '.join(self.stages)}")

        self.config = config
        self.stages = nn.ModuleDict({name: self.stages[name] for name in config.stages})
        for stage in self.ordered_stages:
            stage.config = config

    def use_encoders(self, enabled: bool, seed: int = 0) -> None:
        """Make the encoders' networks, drawn from ``seed``, or remove them; existing networks stay as they are."""
        with initialise_from(derive_seed(seed, "encoders")):
            for module in list(self.modules()):
                if not isinstance(module, Encoder):
                    continue
                if not enabled:
                    module.layers = None
                elif not module.looks:
                    module.add_layers(self.config.encoder_widths)

        self.configure(encoders=enabled)

    @property
    def tone(self) -> ToneDictionary | None:
        """The dictionary of tone curves; None if the curve is learned."""
        stage = self.find(ToneCurve)
        if stage is None:
            return None
        return stage.dictionary

    def typical_tones(self) -> Tensor:
        """Weights ``(K,)`` of the tone curves for a picture of which nothing is known; none if the curve is learned."""
        if self.tone is None:
            return self.colour.matrices.new_zeros(0)
        return self.tone.typical

    def gain_errors(self) -> Tensor:
        """The covariances S_e and S_n of the errors of the gains of grey, float64 ``(2, 3, 3)``; see the module.

        They are those that the fit has measured. An ISP without any believes the file, but for the digital gain if that
        is stated as well.
        """
        measured = self.info.get("gain_errors")
        if measured is not None:
            return torch.tensor(measured, dtype=torch.float64)
        return torch.stack([torch.eye(3), torch.full((3, 3), DIGITAL_SLACK)]).double()

    def reverse_pixels(
        self, x: Tensor, params: ISPParams, coordinates: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """Run the reverse pass without its mosaic.

        Args:
            x: sRGB as float ``(B, 3, H, W)``; or P pixels of it ``(B, 3, 1, P)``, as the pass is pointwise.
            params: the settings of the pictures.
            coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame; by default the picture is the frame.
            seen: a dict to fill with x1 ... x5 by name.

        Returns:
            Linear camera colour x5, of the shape of ``x``.
        """
        for stage in self.ordered_stages:
            x = stage.reverse(x, params, coordinates)
            if seen is not None:
                seen[f"x{stage.makes}"] = x
        return x

    def forward_pixels(
        self, x: Tensor, params: ISPParams, coordinates: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """Run the forward pass after demosaicing; the result is not clipped.

        Args:
            x: linear camera colour x5 ``(B, 3, H, W)``.
            params: the settings of the pictures.
            coordinates: as in :meth:`reverse_pixels`.
            seen: a dict to fill with x4 ... x1 by name.

        Returns:
            sRGB, of the shape of ``x``.
        """
        for stage in reversed(self.ordered_stages):
            x = stage.forward(x, params, coordinates)
            if seen is not None and stage.makes > 1:
                seen[f"x{stage.makes - 1}"] = x
        return x

    def linear(self, x: Tensor) -> Tensor:
        """Compute x2 from sRGB, both ``(B, 3, H, W)``, by the stages in their usual order; it needs no setting."""
        for stage in sorted(self.ordered_stages, key=lambda stage: stage.makes):
            if stage.makes <= 2:
                x = stage.reverse(x, None)
        return x

    def remove_shading(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute x4 from x5, both ``(B, 3, H, W)``; the forward encoders look at x4."""
        for stage in reversed(self.ordered_stages):
            if stage.makes >= 5:
                x = stage.forward(x, None, coordinates)
        return x


# -- what is known of a shot ------------------------------------------------------------------------------------------


def with_white_balance(
    isp: StagedISP,
    params: ISPParams,
    white_balance: Tensor | tuple[float, ...] | None,
    digital_gain: Tensor | float | None,
) -> ISPParams:
    """Fuse the gains and the colour atoms that were chosen for pictures with what the camera states.

    Args:
        isp: the ISP whose dictionaries are used.
        params: the settings chosen for B pictures.
        white_balance: as-shot multipliers of R, G, B, ``(3,)`` or ``(B, 3)``, scaled so that green is 1. None if they
            are not known.
        digital_gain: the factor on all channels, a scalar or ``(B,)``. None if it is not known.

    Raises:
        ValueError: if a multiplier is not positive, or the shapes are for another number of pictures.
    """
    params, _ = _fuse_stated(isp, params, white_balance, digital_gain)
    return params


def _fuse_stated(
    isp: StagedISP,
    params: ISPParams,
    white_balance: Tensor | tuple[float, ...] | None,
    digital_gain: Tensor | float | None,
) -> tuple[ISPParams, Tensor]:
    """Do :func:`with_white_balance`, and also return the covariance P of the gains of grey, float64 ``(B, 3, 3)``."""
    batch = len(params.gains)
    chosen, stated = isp.gain_errors().to(params.gains.device)
    covariance = chosen.expand(batch, 3, 3)

    if white_balance is not None:
        balance = torch.as_tensor(white_balance, dtype=params.gains.dtype, device=params.gains.device)
        if balance.shape not in ((3,), (1, 3), (batch, 3)):
            raise ValueError(f"white_balance must be (3,) or ({batch}, 3), got {tuple(balance.shape)}")
        _require_factor("white_balance", balance)

        balance = (balance / balance[..., 1:2]).expand_as(params.gains)
        weights = isp.colour.weights_for(balance, params.colour_weights)
        grey = log_grey(params)
        seen = balance.log() + weights @ isp.colour.neutral

        share = torch.linalg.solve(chosen + stated, chosen, left=False)
        grey = grey + ((seen - grey).double() @ share.T).to(grey)
        covariance = (chosen - share @ chosen).expand(batch, 3, 3)
        params = with_grey(isp, params, weights, grey)

    if digital_gain is not None:
        digital = torch.as_tensor(digital_gain, dtype=params.gains.dtype, device=params.gains.device).reshape(-1, 1)
        if len(digital) not in (1, batch):
            raise ValueError(f"digital_gain must be a number or ({batch},), got {len(digital)}")
        _require_factor("digital_gain", digital)

        grey = log_grey(params)
        share = covariance[:, :, 1] / covariance[:, 1:2, 1]
        grey = grey + (share * (digital.log() - grey[:, 1:2])).to(grey)
        covariance = covariance - share[:, :, None] * covariance[:, 1:2]
        params = with_grey(isp, params, params.colour_weights, grey)

    return params, covariance


def log_grey(params: ISPParams) -> Tensor:
    """Compute ``log(g / C 1)`` ``(B, 3)``, the logarithm of the gains of grey, of the settings of B pictures."""
    return (params.gains / params.matrix.sum(2).clamp_min(1e-3)).log()


def with_grey(isp: StagedISP, params: ISPParams, colour_weights: Tensor, grey: Tensor) -> ISPParams:
    """Change the weights ``(B, N)`` of the colour atoms, and the logarithms ``(B, 3)`` of the gains of grey."""
    matrix = isp.colour.combine(colour_weights)
    gains = grey.exp() * matrix.sum(2).clamp_min(1e-3)
    return params._replace(colour_weights=colour_weights, matrix=matrix, gains=gains)


Tone = str | Mapping[str, float] | Tensor
"""A tone curve by name, a mixture of curves (shares by name), or weights ``(K,)`` or ``(B, K)`` of all of them."""


def with_tone(isp: StagedISP, params: ISPParams, tone: Tone | None) -> ISPParams:
    """Replace the tone curves of a setting by a known one, or by a mixture.

    Args:
        isp: the ISP whose dictionary of tone curves is used; ``isp.info["tones"]`` has their names.
        params: the settings of B pictures.
        tone: a name such as ``"linear"``, shares by name such as ``{"linear": 0.5, "upi": 0.5}``, or weights ``(K,)``
            or ``(B, K)``. Shares and weights are divided by their sum. None keeps the setting's own.

    Raises:
        ValueError: if the ISP has no such curve, or a share is negative.
    """
    if tone is None:
        return params
    if isp.tone is None:
        raise ValueError("tone: this ISP has learned a curve of its own; only one with a dictionary of curves takes it")
    count = len(isp.tone.curves)
    if isinstance(tone, Tensor):
        weights = tone.to(params.gains)
    elif isinstance(tone, str):
        weights = _tone_shares(isp, {tone: 1.0}, params.gains.new_zeros(count))
    else:
        weights = _tone_shares(isp, tone, params.gains.new_zeros(count))

    batch = len(params.gains)
    if weights.shape not in ((count,), (1, count), (batch, count)):
        raise ValueError(f"tone must be ({count},) or ({batch}, {count}), got {tuple(weights.shape)}")

    total = weights.sum(dim=-1, keepdim=True)
    if not (weights >= 0).all() or not ((total > 0) & total.isfinite()).all():
        raise ValueError("tone: shares must not be negative, and one must be positive")
    return params._replace(tone_weights=(weights / total).expand(batch, count))


def _tone_shares(isp: StagedISP, shares: Mapping[str, float], weights: Tensor) -> Tensor:
    """Put shares by the names of tone curves into ``weights`` ``(K,)``."""
    names = list(isp.info.get("tones", ()))
    for name, share in shares.items():
        if name not in names:
            raise ValueError(f"tone {name!r} is unknown; use one of {', '.join(names)}{suggest(name, names)}")
        weights[names.index(name)] = share
    return weights


def _require_factor(name: str, value: Tensor) -> None:
    if not (value.isfinite() & (value > 0)).all():
        raise ValueError(f"{name} must be positive, got {value.flatten().tolist()}")


def with_raw_samples(
    isp: StagedISP,
    x: Tensor,
    params: ISPParams,
    raw_samples: Tensor,
    coordinates: Tensor,
    white_balance: Tensor | tuple[float, ...] | None = None,
    digital_gain: Tensor | float | None = None,
) -> ISPParams:
    """Fuse the chosen gains with RAW readings and what the camera states; the readings' light weighs the colour atoms.

    Clipped readings do not count.

    Args:
        isp: the camera.
        x: sRGB as float ``(B, 3, H, W)``.
        params: the settings chosen for the pictures.
        raw_samples: ``(B, K, 3)`` of row, column and RAW value.
        coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame.
        white_balance, digital_gain: as for :func:`with_white_balance`.

    Raises:
        ValueError: if a reading is NaN or lies outside the picture.
    """
    _require_places(raw_samples, x)

    rows, columns = raw_samples[..., 0].long(), raw_samples[..., 1].long()
    batch = torch.arange(len(x), device=x.device)[:, None]
    pixels = x[batch, :, rows, columns].transpose(1, 2)[:, :, None]
    where = coordinates.expand(len(x), -1, -1, -1)[batch, :, rows, columns].transpose(1, 2)[:, :, None]

    channel = torch.tensor(isp.cfa.channels, device=x.device)[rows % 2, columns % 2]
    own = F.one_hot(channel, 3).transpose(1, 2).to(x)
    value = raw_samples[..., 2]

    chosen_weights = params.colour_weights
    params, covariance = _fuse_stated(isp, params, white_balance, digital_gain)
    expected = log_grey(params)
    solved, precision = _solve(isp, pixels, where, own, value, params)

    if isp.tone is not None and isinstance(isp.colour, CameraDictionary):
        for _ in range(ROUNDS):
            solved = _fit_mixtures(isp.colour, isp.tone, pixels, own, value, solved)
            solved, precision = _solve(isp, pixels, where, own, value, solved)
    else:
        light = (log_grey(solved) - solved.colour_weights @ isp.colour.neutral).exp()
        weights = isp.colour.weights_for(light, chosen_weights)
        solved = with_grey(isp, solved, weights, log_grey(solved))
        solved, precision = _solve(isp, pixels, where, own, value, solved)

    # P (P + S)^-1 by the readings' precision 1 / S, which is 0 for a channel without any
    information = torch.diag_embed(precision)
    share = torch.linalg.solve(torch.eye(3).to(covariance) + covariance @ information, covariance) @ information
    grey = expected + (share @ (log_grey(solved) - expected).double()[:, :, None])[:, :, 0].to(expected)
    return with_grey(isp, solved, solved.colour_weights, grey)


def _fit_mixtures(
    cameras: CameraDictionary, tones: ToneDictionary, pixels: Tensor, own: Tensor, value: Tensor, params: ISPParams
) -> ISPParams:
    """Fit the mixture of curves, then that of cameras, under the gains in ``params``."""
    target = value * torch.einsum("bck,bc->bk", own, params.gains)
    weight = ((value < CLIPPED) / (value.clamp_min(0.0) + _SHADOW)).sqrt()
    rows = torch.einsum("bck,bcd->bkd", own, params.matrix)
    linear = torch.stack([apply_curves(curve.expand(len(pixels), -1), pixels) for curve in tones.curves], dim=1)
    readings = torch.einsum("bkd,bndk->bnk", rows, linear[:, :, :, 0])
    tone_weights = _nearest(weight * target, weight[:, None] * readings, tones.typical)

    x2 = apply_curves(tones.combine(tone_weights), pixels)[:, :, 0]
    readings = torch.einsum("bck,ncd,bdk->bnk", own, cameras.atoms(), x2)
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


def _require_places(raw_samples: Tensor, x: Tensor) -> None:
    if raw_samples.ndim != 3 or len(raw_samples) != len(x) or raw_samples.shape[2] != 3 or not raw_samples.shape[1]:
        raise ValueError(f"raw_samples are ({len(x)}, K, 3) of (row, column, value), got {tuple(raw_samples.shape)}")
    if not raw_samples.isfinite().all():
        raise ValueError("raw_samples: a value is NaN; remove such readings")

    sides = torch.tensor(x.shape[-2:], device=raw_samples.device)
    if ((raw_samples[..., :2] < 0) | (raw_samples[..., :2] >= sides)).any():
        raise ValueError(f"raw_samples: a row or column is outside the picture, {x.shape[-2]} x {x.shape[-1]}")


def _solve(
    isp: StagedISP, pixels: Tensor, where: Tensor, own: Tensor, value: Tensor, params: ISPParams
) -> tuple[ISPParams, Tensor]:
    """Solve for the gains of the readings; also return the precision of their logarithms, float64 ``(B, 3)``."""
    unit = params._replace(gains=torch.ones_like(params.gains))
    x5 = isp.reverse_pixels(pixels, unit, where)[:, :, 0]
    y = value[:, None].expand_as(x5)
    usable = own * (y < CLIPPED)
    weight = usable / (y.clamp_min(0.0) + _SHADOW)
    inverse = torch.ones_like(params.gains)
    for _ in range(ROUNDS):
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
