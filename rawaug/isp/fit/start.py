"""The start of a fit: every frame's own colour, the atoms of the dictionaries, and the constant weights.

A frame's colour is ``M_f = diag(1 / g_f) C_f`` (sRGB to RAW), with the rows of ``C_f`` l1-normalised. Frames of one
camera share ``M_f`` divided by its row sums ``s_f``, and ``k_f = s_f wb_f``, which is 1 if the metadata are exact. Both
are drawn together by ``rho(d) = tau^2 d^2 / (tau^2 + d^2)`` (Geman and McClure), under which wrong metadata cost a
constant.

The constant weights minimise ``sum_f log(E_f(w) + eps)``, because the score averages decibels. ``E_f`` is the squared
error in excess of that of the frame's best gains. It is quadratic in the inverse gains ``u``: with second moments
``a = <x^2>``, ``b = <x y>`` of a channel it is ``(u a - b)^2 / a``. Clipped readings are not used.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from rawaug.isp import functional
from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import l1_normalise, log_light
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.samples import FitFrames, FrameSummary, PixelSamples, as_shot
from rawaug.isp.fusion import DIGITAL_SLACK, log_grey
from rawaug.isp.model import DictionaryISP
from rawaug.seeding import derive_seed

TIE = 1e-1
"""Weight of the deviations; the squared errors of a good fit are about 1e-6."""
TIE_RANGE = 0.05
"""The scale tau; deviations of frames that belong together are a few hundredths at most."""
FEWEST_PIXELS = 32


@dataclass
class FrameColour:
    """The colour of each of F frames, refined together with the global parameters.

    Args:
        log_scale: ``(F, 3)``, logarithm of one over the gains.
        matrix: ``(F, 3, 3)``, whose rows are l1-normalised on use.
    """

    log_scale: Tensor
    matrix: Tensor

    @classmethod
    def from_product(cls, product: Tensor) -> FrameColour:
        """Split ``M`` ``(F, 3, 3)``."""
        return cls(product.abs().sum(2).log(), l1_normalise(product))

    def product(self) -> Tensor:
        """Compute ``M`` ``(F, 3, 3)``."""
        return self.log_scale.exp()[:, :, None] * l1_normalise(self.matrix)

    def params(self) -> ISPParams:
        """The settings of the frames in the ISP's form, without weights."""
        none = self.log_scale.new_empty(len(self.log_scale), 0)
        return ISPParams(none, none, l1_normalise(self.matrix), torch.exp(-self.log_scale), none)

    def pick(self, frames: Tensor | slice) -> FrameColour:
        """Take the colours of some frames, by an index ``(f,)`` or a slice."""
        return FrameColour(self.log_scale[frames], self.matrix[frames])

    def neutral(self, balance: Tensor) -> tuple[Tensor, Tensor]:
        """White-keeping matrices ``(F, 3, 3)`` and ``log k`` ``(F, 3)``, given the as-shot balance ``(F, 3)``."""
        product = self.product()
        rows = product.sum(2)
        return product / rows[:, :, None], rows.clamp_min(1e-3).log() + balance.log()


class Tie:
    """A penalty that draws the frames of one camera together."""

    def __init__(self, shots: Sequence[FrameSummary]) -> None:
        numbers: dict[str, list[int]] = {}
        for number, shot in enumerate(shots):
            numbers.setdefault(shot.camera, []).append(number)

        self.groups = list(map(torch.tensor, numbers.values()))
        self.balance = as_shot(shots)

    def __call__(self, colour: FrameColour) -> Tensor:
        matrix, neutral = colour.neutral(self.balance)
        values = torch.cat([matrix.flatten(1), neutral], dim=1)
        centre = torch.empty_like(values)
        for group in self.groups:
            centre[group] = values.detach()[group].quantile(0.5, dim=0)

        square = (values - centre) ** 2
        bounded: Tensor = TIE_RANGE**2 * square / (TIE_RANGE**2 + square)
        return TIE * bounded.sum(1).mean()


_CAMERA_RIDGE = 1e-3
"""Weight of a known camera's matrix in the start, as a share of the mean square of the colours."""


@torch.no_grad()
def least_squares(linear: Tensor, samples: PixelSamples, known_matrix: Tensor | None = None) -> Tensor:
    """Solve for ``M_f`` ``(F, 3, 3)``, which takes ``linear`` ``(F, 3, 1, P)`` to the readings, by least squares.

    If the colours of a frame do not determine it, ``known_matrix`` ``(F, 3, 3)`` does, from linear sRGB to
    white-balanced camera RGB: the ridge draws ``M_f`` to its rows, each times the gain that fits the readings best.
    """
    x = linear[:, :, 0].double()
    y, known = samples.target[:, :, 0].double(), samples.known[:, :, 0].double()
    if (known.sum(2) < FEWEST_PIXELS).any():
        frame = int((known.sum(2) < FEWEST_PIXELS).any(1).nonzero()[0])
        raise ValueError(f"frame {frame}: too few unclipped pixels to fit; use a better exposed frame or more pixels")

    moments = torch.einsum("fip,fjp,fcp->fcij", x, x, known)
    cross = torch.einsum("fip,fcp,fcp->fci", x, y, known)
    power = moments.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    if known_matrix is None:
        return torch.linalg.solve(moments + 1e-9 * power * torch.eye(3).double(), cross).float()

    rows = known_matrix.double()
    gains = (rows * cross).sum(2) / torch.einsum("fci,fcij,fcj->fc", rows, moments, rows)
    rows = gains[:, :, None] * rows
    ridge = _CAMERA_RIDGE * power * torch.eye(3).double()
    return torch.linalg.solve(moments + ridge, cross + _CAMERA_RIDGE * power[..., 0] * rows).float()


@torch.no_grad()
def fit_fall_off(linear: Tensor, samples: PixelSamples, product: Tensor) -> tuple[Tensor, Tensor]:
    """Fit the mean ``(2,)`` and precision ``(2, 2)`` of a Gaussian to log(reading / prediction).

    ``product`` ``(F, 3, 3)`` takes ``linear`` ``(F, 3, 1, P)`` to the prediction.
    """
    # A quadratic in the coordinates; an offset per frame and channel absorbs the effect of the mask on the matrices.
    predicted = functional.correct_colour(linear, product)
    bright = (samples.known * (samples.target > 0.02) * (predicted > 0.02))[:, :, 0].double()
    ratio = (samples.target.clamp_min(1e-3) / predicted.clamp_min(1e-3)).log()[:, :, 0].double()
    y, x = samples.coordinates[:, :, 0].double().unbind(1)
    terms = torch.stack([y, x, y * y, y * x, x * x], dim=1)  # (F, 5, P)
    count = bright.sum(2, keepdim=True).clamp_min(1.0)
    ratio = ratio - (ratio * bright).sum(2, keepdim=True) / count
    means = torch.einsum("fkp,fcp->fkc", terms, bright) / count.transpose(1, 2)
    centred = (terms[:, :, None] - means[..., None]) * bright[:, None]  # (F, 5, 3, P)
    normal = torch.einsum("fkcp,flcp->kl", centred, centred) + 1e-6 * torch.eye(5).double()
    c = torch.linalg.solve(normal, torch.einsum("fkcp,fcp->k", centred, ratio))
    precision = -torch.stack([2 * c[2], c[3], c[3], 2 * c[4]]).reshape(2, 2)
    mean = torch.linalg.lstsq(precision, c[:2, None]).solution[:, 0]  # double to the end: sums vary in their last bit
    return mean.clamp(-0.5, 0.5).float(), precision.float()


_SPREADS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, torch.inf)
_SPREAD_EPS = 1e-6
"""Constant under the logarithm, so that a frame that nothing predicts does not decide alone."""
_KNEES = (0.9, 0.93, 0.95, 0.97, 0.98, 0.99)
_FRAMES_AT_ONCE = 16
"""Number of frames whose pixels pass the stages at a time, so that memory does not grow with the number of frames."""
REACH_ATOMS = 8
_LEAST_DETERMINANT = 0.05
"""Minimum determinant of a matrix with rows of l1 norm 1; published cameras have 0.1 and more."""


def set_dictionaries(
    isp: DictionaryISP, colour: FrameColour, samples: PixelSamples, shots: Sequence[FrameSummary], config: FitConfig
) -> None:
    """Set the knee, the atoms and the constant weights of an ISP from the frames.

    Args:
        isp: the ISP whose dictionaries are set.
        colour: the colour of each frame.
        samples: the pixels of the frames.
        shots: the summaries of the frames.
        config: the settings of the fit.
    """
    _set_knee(isp, colour, samples)
    _set_atoms(isp, colour, shots, config)
    set_priors(isp, samples, config)


@torch.no_grad()
def _set_atoms(isp: DictionaryISP, colour: FrameColour, shots: Sequence[FrameSummary], config: FitConfig) -> None:
    """Make the frames' matrices and gains the atoms, or their clusters if there are more frames than atoms.

    Args:
        isp: the ISP whose dictionaries are set.
        colour: the colour of each frame.
        shots: the summaries of the frames.
        config: gives the reach of further gain atoms, and the seed of the clusters.
    """
    balance = as_shot(shots)
    params = colour.params()
    light, neutral = log_light(balance), -colour.neutral(balance)[1]
    count = isp.config.colour_atoms
    points = torch.cat([params.matrix.flatten(1), params.gains.log()], dim=1)
    members = torch.arange(len(points))
    if len(points) > count:
        plausible = plausible_matrices(params.matrix).nonzero()[:, 0]
        if len(plausible) >= count:
            members = plausible

    groups = points.new_zeros(count, len(points))
    groups[:, members] = _groups(points[members], count, config.seed)
    isp.colour.matrices.copy_((groups @ params.matrix.flatten(1)).unflatten(1, (3, 3)))
    isp.colour.light.copy_(groups @ light)
    isp.colour.neutral.copy_(groups @ neutral)
    isp.colour.spread.fill_(_spread(colour, balance))
    red, green, blue = (groups @ params.gains.log()).unbind(1)
    frames = torch.stack([green, red - green, blue - green], dim=1)
    more = reach_atoms(isp.config.gain_atoms - count, config.reach)
    isp.gain.log_gains.copy_(torch.cat([frames, frames.mean(0) + more]))


def plausible_matrices(matrices: Tensor) -> Tensor:
    """Say which matrices ``(F, 3, 3)`` from sRGB may be a camera's: booleans ``(F,)``.

    In a camera's matrix each channel sees its own primary most, and the matrix is far from singular. Frames of few
    colours leave their matrices undetermined, and must not become atoms.
    """
    primary = matrices.diagonal(dim1=1, dim2=2)
    crosstalk = matrices.abs() - torch.diag_embed(primary.abs())
    return (primary > crosstalk.amax(dim=2)).all(dim=1) & (torch.linalg.det(matrices) > _LEAST_DETERMINANT)


def reach_atoms(count: int, reach: float) -> Tensor:
    """Make gain atoms that no frame had, as log offsets (digital, red, blue) from the frames' mean, ``(count, 3)``.

    They are the corners of a box, starting with those of a tetrahedron.
    """
    corners = sorted(product((-1.0, 1.0), repeat=3), key=lambda corner: corner[0] * corner[1] * corner[2])
    size = torch.tensor([0.25, 1.0, 1.0]) * torch.tensor(reach).log()
    return torch.tensor(corners[:count]).reshape(-1, 3) * size


def _groups(points: Tensor, count: int, seed: int) -> Tensor:
    """Make an averaging matrix ``(count, F)``: the identity for as many points, else that of k-means clusters."""
    if len(points) == count:
        return torch.eye(count)

    from scipy.cluster.vq import kmeans2

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # k-means warns of an empty cluster, which occurs if all frames are alike
        _, labels = kmeans2(points.double().numpy(), count, minit="++", rng=derive_seed(seed, "atoms") % 2**32)

    member = torch.nn.functional.one_hot(torch.from_numpy(labels).long(), count).T.float()
    used = member.sum(1, keepdim=True)
    # An empty cluster becomes the mean of all points.
    return torch.where(used > 0, member / used.clamp_min(1.0), torch.full_like(member, 1.0 / len(points)))


def _spread(colour: FrameColour, balance: Tensor) -> float:
    """Find the kernel width that best predicts each frame's colour from those of the others in similar light."""
    if len(balance) < 3:
        return torch.inf

    matrix, neutral = colour.neutral(balance)
    values = torch.cat([matrix.flatten(1), neutral], dim=1)
    distance = torch.cdist(log_light(balance), log_light(balance)) ** 2
    distance.fill_diagonal_(torch.inf)
    errors: dict[float, float] = {}
    for width in _SPREADS:
        logits = torch.where(distance.isinf(), -torch.inf, 0.0)
        if width < torch.inf:
            logits = -distance / (2.0 * width**2)
        square = ((values - logits.softmax(1) @ values) ** 2).sum(1)
        errors[width] = float((square + _SPREAD_EPS).log().sum())

    return min(errors, key=lambda width: errors[width])


@torch.no_grad()
def _set_knee(isp: DictionaryISP, colour: FrameColour, samples: PixelSamples) -> None:
    """Set the knee, above which highlights are spared, to the one that suits all pixels best, clipped ones included."""
    errors: dict[float, float] = {}
    for knee in _KNEES:
        isp.configure(knee=knee)
        predicted = _reverse_in_parts(isp, samples, colour.params()).clamp(0.0, 1.0)
        square = (predicted - samples.target) ** 2 * samples.site
        errors[knee] = float((square.sum((1, 2, 3)) / samples.site.sum((1, 2, 3)) + 1e-6).log().sum())

    isp.configure(knee=min(errors, key=lambda knee: errors[knee]))


def _reverse_in_parts(isp: DictionaryISP, samples: PixelSamples, params: ISPParams) -> Tensor:
    """Compute x5 ``(F, 3, 1, P)`` of all frames, a few at a time, as the networks need far more memory than x5.

    Args:
        isp: the ISP whose reverse pass is run.
        samples: the pixels of F frames.
        params: a setting for each frame, or one for all.
    """
    count = len(samples.srgb)
    params = params.map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))

    parts: list[Tensor] = []
    for index in torch.arange(count).split(_FRAMES_AT_ONCE):
        part = samples.of_frames(index)
        of_part = ISPParams(*[tensor[index] for tensor in params])
        parts.append(isp.reverse_pixels(part.srgb, of_part, part.coordinates))

    return torch.cat(parts)


_LIGHT_PIXELS = 1024
"""Number of pixels of a frame that serve to measure the lights of trained atoms."""
_LIGHT_RIDGE = 1e-2
"""Ridge that pulls the neutrals of rarely used atoms to the mean."""


@torch.no_grad()
def measure_lights(isp: DictionaryISP, frames: FitFrames) -> None:
    """Measure the light, the neutral and the spread of colour atoms anew, since training has moved them.

    An atom's light is the mean light of the frames that choose it, if encoders choose. The neutrals are those under
    which as-shot gains come nearest to each frame's best gains, and the spread is the one that works best with them.
    """
    balance = frames.as_shot
    chosen = _chosen(isp, frames).colour_weights
    if isp.config.encoders:
        share = chosen / chosen.sum(dim=0).clamp_min(1e-6)
        isp.colour.light.copy_(share.T @ log_light(balance))

    errors: dict[float, float] = {}
    neutrals: dict[float, Tensor] = {}
    for spread in _SPREADS:
        isp.colour.spread.fill_(spread)
        weights = isp.colour.weights_for(balance, chosen)
        best, power, has_pixels = _best_grey(isp, frames, weights)
        neutrals[spread] = _solve_mixture(weights, best - balance.log())
        off = (best - balance.log() - weights @ neutrals[spread]).exp() - 1.0
        errors[spread] = float(((has_pixels * power * off**2).sum(dim=1) + _SPREAD_EPS).log().sum())

    spread = min(errors, key=lambda width: errors[width])
    isp.colour.spread.fill_(spread)
    isp.colour.neutral.copy_(neutrals[spread])


FEWEST_JUDGES = 8
"""Minimum number of frames to judge encoders on."""
_CHOICE_VARIANCE = 0.03
"""Variance of the logarithms of chosen gains in the frames that stand for what is known before any is measured."""
_PRIOR_FRAMES = 3
_CLEARLY = 0.25
"""A file's digital gain is believed if its variance is at most this share of that of the chosen one."""
_UNKNOWN = 1e4
"""Variance of the logarithm of a digital gain that is not believed."""


@torch.no_grad()
def measure_gain_errors(isp: DictionaryISP, watched: FitFrames | None) -> None:
    """Measure how far off chosen gains and as-shot gains are, and note the covariances in ``isp.info``.

    Args:
        isp: the fitted ISP.
        watched: frames that the encoders were not trained on. Without enough of them, and of constants, nothing is
            measured: the file then decides.
    """
    if not isp.config.encoders or watched is None or len(watched.shots) < FEWEST_JUDGES:
        return

    chosen = _chosen(isp, watched)
    balance = watched.as_shot
    weights = isp.colour.weights_for(balance, chosen.colour_weights)
    best, _, has_pixels = _best_grey(isp, watched, weights)
    usable = has_pixels.bool().all(dim=1)

    of_choice = (log_grey(chosen) - best)[usable].double()
    of_file = (balance.log() + weights @ isp.colour.neutral - best)[usable].double()
    count = len(of_choice) + _PRIOR_FRAMES
    choice = (of_choice.T @ of_choice + _PRIOR_FRAMES * _CHOICE_VARIANCE * torch.eye(3)) / count
    file = of_file.T @ of_file / count + DIGITAL_SLACK
    if file[1, 1] > _CLEARLY * choice[1, 1]:
        file = file + _UNKNOWN
    isp.info["gain_errors"] = [choice.tolist(), file.tolist()]


def _chosen(isp: DictionaryISP, frames: FitFrames) -> ISPParams:
    """The settings that the ISP chooses for the frames."""
    settings = [isp.choose(shot.srgb) for shot in frames.shots]
    return ISPParams(*map(torch.cat, zip(*settings, strict=True)))


def _best_grey(isp: DictionaryISP, frames: FitFrames, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the logarithms ``(F, 3)`` of each frame's best gains of grey under weights ``(F, N)`` of the colour atoms.

    Also return the power of its readings that they explain, and which channels have any pixel.
    """
    pixels = frames.pixels.pick(torch.arange(min(_LIGHT_PIXELS, frames.pixels.srgb.shape[-1])))
    matrix = isp.colour.combine(weights)
    a, b, has_pixels = _second_moments(isp, pixels, weights, matrix)
    inverse = b.clamp_min(1e-9) / a.clamp_min(1e-9)
    return -inverse.log() - matrix.sum(2).clamp_min(1e-3).log(), b.square() / a.clamp_min(1e-9), has_pixels


def _second_moments(
    isp: DictionaryISP, pixels: PixelSamples, weights: Tensor, matrix: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute ``<x x>`` and ``<x y>`` of each frame's channels under gains of 1, and which channels have any pixel."""
    count = len(matrix)
    none = weights.new_empty(count, 0)
    tones = isp.typical_tones().expand(count, -1)
    params = ISPParams(weights, none, matrix, torch.ones(count, 3), tones)

    x = _reverse_in_parts(isp, pixels, params)
    a = (x * x * pixels.known).mean((2, 3))
    b = (x * pixels.target * pixels.known).mean((2, 3))
    return a, b, (a > 0).float()


def _solve_mixture(weights: Tensor, wanted: Tensor) -> Tensor:
    """Find values of the atoms ``(N, 3)`` whose mixtures by ``weights`` ``(F, N)`` are near ``wanted`` ``(F, 3)``."""
    mean = wanted.median(dim=0).values
    normal = weights.T @ weights + _LIGHT_RIDGE * torch.eye(weights.shape[1])
    return mean + torch.linalg.solve(normal, weights.T @ (wanted - mean))


def set_priors(isp: DictionaryISP, samples: PixelSamples, config: FitConfig) -> None:
    """Set the constant weights: equal ones for the colour atoms, and those that serve the frames best for the gains."""
    colour_weights = torch.full((isp.config.colour_atoms,), 1.0 / isp.config.colour_atoms)
    with torch.no_grad():
        plain = isp.params_from_weights(colour_weights[None], torch.ones(1, isp.config.gain_atoms))
        plain = plain._replace(gains=torch.ones(1, 3))
        x = _reverse_in_parts(isp, samples, plain)
        a = (samples.known * (x * x)).mean((2, 3))
        b = (samples.known * (x * samples.target)).mean((2, 3))

    inverse = 1.0 / isp.gain.channel_gains().detach()
    weights = best_constants(a, b, inverse, config.prior_steps, config.mse_floor)
    for encoders in (isp.reverse_encoders, isp.forward_encoders):
        encoders.colour.set_prior(colour_weights)
        encoders.gain.set_prior(weights)


def best_constants(a: Tensor, b: Tensor, inverse_atoms: Tensor, steps: int = 400, mse_floor: float = 1e-5) -> Tensor:
    """Find the weights of the gain atoms that serve the frames best by gradient descent; see the module.

    Args:
        a, b: second moments of the frames, ``(F, 3)``.
        inverse_atoms: one over the gains of the atoms, ``(M, 3)``.
        steps: number of steps of the descent.
        mse_floor: added to a frame's squared error under the logarithm.

    Returns:
        Weights ``(M,)`` on the simplex.
    """
    logits = torch.zeros(len(inverse_atoms), requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.05)
    for _ in range(steps):
        u = logits.softmax(0) @ inverse_atoms
        loss = (((u * a - b) ** 2 / a.clamp_min(1e-9)).sum(1) + mse_floor).log().sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    return logits.detach().softmax(0)
