"""The frames' colours become the atoms of the dictionaries, with the constant weights that serve the frames best.

The constant weights minimise ``sum_f log(E_f(w) + eps)``, because the score averages decibels. ``E_f`` is the squared
error in excess of that of the frame's best gains. It is quadratic in the inverse gains ``u``: with second moments
``a = <x^2>``, ``b = <x y>`` of a channel it is ``(u a - b)^2 / a``. Clipped readings are not used.

After end-to-end training, which moves the atoms, their lights and the errors of the gains are measured.
"""

from __future__ import annotations

import warnings
from itertools import product

import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import log_light
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.samples import FitFrames, PixelSamples
from rawaug.isp.fit.start import FrameColour
from rawaug.isp.fusion import DIGITAL_SLACK, log_grey
from rawaug.isp.model import DictionaryISP
from rawaug.seeding import derive_seed

_SPREADS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, torch.inf)
_SPREAD_EPS = 1e-6
"""Constant under the logarithm, so that a frame that nothing predicts does not decide alone."""
_KNEES = (0.9, 0.93, 0.95, 0.97, 0.98, 0.99)
_FRAMES_AT_ONCE = 16
"""Number of frames whose pixels pass the stages at a time, so that memory does not grow with the number of frames."""
REACH_ATOMS = 8
_LEAST_DETERMINANT = 0.05
"""Minimum determinant of a matrix with rows of l1 norm 1; published cameras have 0.1 and more."""


def set_dictionaries(isp: DictionaryISP, colour: FrameColour, frames: FitFrames, config: FitConfig) -> None:
    """Set the knee, the atoms and the constant weights of an ISP from the frames.

    Args:
        isp: the ISP whose dictionaries are set.
        colour: the colour of each frame.
        frames: the frames.
        config: the settings of the fit.
    """
    _set_knee(isp, colour, frames.pixels)
    _set_atoms(isp, colour, frames.as_shot, config)
    set_priors(isp, frames.pixels, config)


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


@torch.no_grad()
def _set_atoms(isp: DictionaryISP, colour: FrameColour, balance: Tensor, config: FitConfig) -> None:
    """Make the frames' matrices and gains the atoms, or their clusters if there are more frames than atoms.

    Args:
        isp: the ISP whose dictionaries are set.
        colour: the colour of each of F frames.
        balance: their as-shot multipliers, ``(F, 3)``.
        config: gives the reach of further gain atoms, and the seed of the clusters.
    """
    params = colour.params()
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
    isp.colour.light.copy_(groups @ log_light(balance))
    isp.colour.neutral.copy_(groups @ -colour.neutral(balance)[1])
    isp.colour.spread.fill_(_spread(colour, balance))

    red, green, blue = (groups @ params.gains.log()).unbind(1)
    atoms = torch.stack([green, red - green, blue - green], dim=1)
    more = reach_atoms(isp.config.gain_atoms - count, config.reach)
    isp.gain.log_gains.copy_(torch.cat([atoms, atoms.mean(0) + more]))


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
        parts.append(isp.stages.reverse(part.srgb, of_part, part.coordinates))

    return torch.cat(parts)


def set_priors(isp: DictionaryISP, samples: PixelSamples, config: FitConfig) -> None:
    """Set the constant weights: equal ones for the colour atoms, and those that serve the frames best for the gains."""
    colour_weights = torch.full((isp.config.colour_atoms,), 1.0 / isp.config.colour_atoms)
    with torch.no_grad():
        plain = isp.params_from_weights(colour_weights[None], torch.ones(1, isp.config.gain_atoms))
        a, b = _second_moments(isp, samples, plain._replace(gains=torch.ones(1, 3)))

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
    none = weights.new_empty(len(weights), 0)
    tones = isp.typical_tones().expand(len(weights), -1)
    a, b = _second_moments(isp, pixels, ISPParams(weights, none, matrix, torch.ones(len(weights), 3), tones))

    inverse = b.clamp_min(1e-9) / a.clamp_min(1e-9)
    grey = -inverse.log() - matrix.sum(2).clamp_min(1e-3).log()
    return grey, b.square() / a.clamp_min(1e-9), (a > 0).float()


def _second_moments(isp: DictionaryISP, pixels: PixelSamples, params: ISPParams) -> tuple[Tensor, Tensor]:
    """Compute ``a = <x x>`` and ``b = <x y>`` of each frame's channels, ``(F, 3)``; ``params`` have gains of 1."""
    x = _reverse_in_parts(isp, pixels, params)
    return (x * x * pixels.known).mean((2, 3)), (x * pixels.target * pixels.known).mean((2, 3))


def _solve_mixture(weights: Tensor, wanted: Tensor) -> Tensor:
    """Find values of the atoms ``(N, 3)`` whose mixtures by ``weights`` ``(F, N)`` are near ``wanted`` ``(F, 3)``."""
    mean = wanted.median(dim=0).values
    normal = weights.T @ weights + _LIGHT_RIDGE * torch.eye(weights.shape[1])
    return mean + torch.linalg.solve(normal, weights.T @ (wanted - mean))
