r"""From RAW-sRGB pairs to a :class:`DictionaryISP`, in seconds, from one frame upwards.

1. Closed form. With gamma 2.2 and no tone curve, least squares gives each frame's matrix ``M_f`` (sRGB to RAW,
   unclipped pixels); ``M_f = diag(1 / g_f) C_f`` with rows of ``C_f`` l1-normalised. What ``log(y / M_f x2)`` leaves as
   a quadratic of the place in the frame starts the Gaussian shading mask.
2. Refinement of all reverse parameters together, ``min sum_f mean_p (sqrt(y) - sqrt(y_hat))^2``: the square root makes
   shot noise, hence error, even over the range.
3. Least squares again through the learned tone; the frames' matrices and gains become the atoms.
4. Constant weights on the simplex by ``min_w sum_f log(MSE_f(w) + eps)``: the score averages decibels.
5. The forward networks, given the parameters of the reverse pass: l2 on sRGB and on the intermediate x1.

Source: the model and losses of Conde et al., AAAI 2022; splitting the fit into a global and a per-frame part is what
makes it hold up with a handful of frames (``docs/fit.md``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from rawaug.bayer import CFA
from rawaug.isp import stages
from rawaug.isp.dictionary import l1_normalised
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPConfig, ISPParams
from rawaug.isp.samples import FramePair, PixelSamples, sample_pixels
from rawaug.seeding import derived_seed, keyed_generator

LOG_MSE_EPS = 1e-5
"""Added to a frame's MSE under the logarithm: frames beyond 50 dB count no more."""


@dataclass(frozen=True)
class FitConfig:
    """How an ISP is fitted.

    Args:
        atoms: largest number of atoms in each dictionary; fewer frames give fewer atoms, more are clustered.
        steps: refinement steps of each direction.
        pixels: random pixels kept of each frame.
        batch: pixels of each frame in a step.
        learning_rate: of Adam, falling to 0 by a cosine.
        shading: "on" fits the lens shading mask, "off" leaves the stage out, "auto" decides by the closed form: a mask
            that takes less than 5% at the corner is within what the frames' content feigns.
        attention: fit the attention mask as well.
        noisy: fit on the captured noisy RAW of the pairs.
        seed: of the pixels drawn and of the networks' start.
        isp: further keys of :class:`rawaug.isp.params.ISPConfig`, such as ``encoder_widths``.
    """

    atoms: int = 16
    steps: int = 300
    pixels: int = 32768
    batch: int = 4096
    learning_rate: float = 5e-3
    shading: Literal["auto", "on", "off"] = "auto"
    attention: bool = False
    noisy: bool = False
    seed: int = 0
    isp: dict[str, Any] = field(default_factory=dict)


@dataclass
class FrameColour:
    """Per-frame colour, refined together with the global parameters: ``M_f = diag(exp(log_scale_f)) C_f``."""

    log_scale: Tensor  # (F, 3), log of 1 / gains
    matrix: Tensor  # (F, 3, 3), rows l1-normalised on use

    @classmethod
    def from_product(cls, product: Tensor) -> FrameColour:
        """Split ``M`` ``(F, 3, 3)``."""
        return cls(product.abs().sum(2).log(), l1_normalised(product))

    def product(self) -> Tensor:
        """``M`` ``(F, 3, 3)``."""
        return self.log_scale.exp()[:, :, None] * l1_normalised(self.matrix)

    def params(self) -> ISPParams:
        """As the ISP takes them (without weights)."""
        none = self.log_scale.new_empty(len(self.log_scale), 0)
        return ISPParams(none, none, l1_normalised(self.matrix), torch.exp(-self.log_scale))


class _Shot(NamedTuple):
    """What is kept of a frame besides its pixels."""

    name: str
    cfa: CFA
    white_balance: tuple[float, float, float]


def _noting(pairs: Iterable[FramePair], shots: list[_Shot]) -> Iterator[FramePair]:
    """``pairs``, each noted in ``shots`` as it passes: reading a RAW file twice would take as long as the fit."""
    for pair in pairs:
        shots.append(_Shot(pair.name, CFA(pair.cfa), pair.white_balance))
        yield pair


def fit_isp(pairs: Sequence[FramePair], config: FitConfig | None = None, progress: bool = True) -> DictionaryISP:
    """Fit a dictionary ISP to pairs of RAW and sRGB.

    Args:
        pairs: one or more frames, of one or several cameras.
        config: settings; see :class:`FitConfig`.
        progress: show progress bars.

    Raises:
        ValueError: if there is no pair or a frame has too few unclipped pixels.
    """
    config = config or FitConfig()
    shots: list[_Shot] = []
    reading = tqdm(pairs, desc="read", unit="frame", leave=False, disable=None if progress else True)
    samples = sample_pixels(_noting(reading, shots), config.pixels, config.seed, config.noisy)
    patterns = {shot.cfa for shot in shots}
    count = min(config.atoms, len(samples.srgb))
    settings = {
        "colour_atoms": count, "gain_atoms": count, "attention": config.attention,
        "cfa": str(patterns.pop()) if len(patterns) == 1 else "RGGB", **config.isp,
    }  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(derived_seed(config.seed, "isp"))
        isp = DictionaryISP(ISPConfig(**settings))
    colour = _closed_form(isp, samples, config.shading)
    _refine_reverse(isp, colour, samples, config, progress)
    colour = FrameColour.from_product(_least_squares(isp, samples, colour))
    _set_atoms(isp, colour, config.seed)
    _set_priors(isp, samples, colour)
    balance = torch.tensor([shot.white_balance for shot in shots])
    isp.neutral_gains.copy_(-(colour.log_scale + balance.log()).mean(0)).exp_()
    _refine_forward(isp, colour, samples, config, progress)
    isp.info = {"frames": [shot.name for shot in shots], "steps": config.steps, "seed": config.seed}
    return isp.eval()


def _linear(isp: DictionaryISP, samples: PixelSamples, colour: FrameColour | None = None) -> Tensor:
    """x2 times the shading masks: what a matrix takes to RAW, ``(F, 3, 1, P)``; attention needs the current colour."""
    x2 = stages.gamma_expand(isp.reverse_networks.tone(samples.srgb), isp.reverse_networks.gamma)
    if "shading" not in isp.config.stages:
        return x2
    mask = isp.shading(samples.place)
    if isp.config.attention and colour is not None:
        mask = mask * isp.reverse_networks.attention(mask * stages.correct_colour(x2, colour.product()))
    return x2 * mask


@torch.no_grad()
def _least_squares(isp: DictionaryISP, samples: PixelSamples, colour: FrameColour | None = None) -> Tensor:
    """``M_f`` ``(F, 3, 3)`` from the normal equations, channel by channel, in double precision."""
    x = _linear(isp, samples, colour)[:, :, 0].double()
    y, known = samples.target[:, :, 0].double(), samples.known[:, :, 0].double()
    if (known.sum(2) < 32).any():
        frame = int((known.sum(2) < 32).any(1).nonzero()[0])
        raise ValueError(f"frame {frame}: too few unclipped pixels to fit; take a better exposed frame or more pixels")
    moments = torch.einsum("fip,fjp,fcp->fcij", x, x, known)
    cross = torch.einsum("fip,fcp,fcp->fci", x, y, known)
    ridge = 1e-9 * moments.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(3).double()
    return torch.linalg.solve(moments + ridge, cross).float()


@torch.no_grad()
def _closed_form(isp: DictionaryISP, samples: PixelSamples, shading: str) -> FrameColour:
    """Step 1: matrices with a plain gamma, and the Gaussian mask from what they leave."""
    product = _least_squares(isp, samples)
    if "shading" in isp.config.stages:
        mean, precision = _fall_off(isp, samples, product)
        half_corner = 0.5 * torch.linalg.eigvalsh(precision).clamp_min(0.0).sum() * 0.5
        if shading == "off" or (shading == "auto" and half_corner < -math.log(0.95)):
            isp.config = replace(isp.config, stages=tuple(s for s in isp.config.stages if s != "shading"))
        else:
            isp.shading.set(mean, precision)
            product = _least_squares(isp, samples)
    return FrameColour.from_product(product)


def _fall_off(isp: DictionaryISP, samples: PixelSamples, product: Tensor) -> tuple[Tensor, Tensor]:
    """Mean ``(2,)`` and precision ``(2, 2)`` of the Gaussian that best explains log(reading / prediction).

    One offset a frame and channel takes up what the mask does to the matrices, so that only the shape is left.
    """
    predicted = stages.correct_colour(_linear(isp, samples), product)
    bright = (samples.known * (samples.target > 0.02) * (predicted > 0.02))[:, :, 0].double()
    ratio = (samples.target.clamp_min(1e-3) / predicted.clamp_min(1e-3)).log()[:, :, 0].double()
    y, x = samples.place[:, :, 0].double().unbind(1)
    terms = torch.stack([y, x, y * y, y * x, x * x], dim=1)  # (F, 5, P)
    count = bright.sum(2, keepdim=True).clamp_min(1.0)
    ratio = ratio - (ratio * bright).sum(2, keepdim=True) / count
    means = torch.einsum("fkp,fcp->fkc", terms, bright) / count.transpose(1, 2)
    centred = (terms[:, :, None] - means[..., None]) * bright[:, None]  # (F, 5, 3, P)
    normal = torch.einsum("fkcp,flcp->kl", centred, centred) + 1e-6 * torch.eye(5).double()
    c = torch.linalg.solve(normal, torch.einsum("fkcp,fcp->k", centred, ratio)).float()
    precision = -torch.tensor([[2 * c[2], c[3]], [c[3], 2 * c[4]]])
    mean = torch.linalg.lstsq(precision, c[:2, None]).solution[:, 0]
    return mean.clamp(-0.5, 0.5), precision


def _refine_reverse(
    isp: DictionaryISP, colour: FrameColour, samples: PixelSamples, config: FitConfig, progress: bool
) -> None:
    """Step 2: tone, gamma, shading and the frames' colours by gradient descent on random pixels."""
    networks = isp.reverse_networks
    colour.log_scale.requires_grad_()
    colour.matrix.requires_grad_()
    parameters = [*networks.tone.parameters(), networks.gamma, colour.log_scale, colour.matrix]
    parameters += [*isp.shading.parameters(), *networks.attention.parameters()]

    def loss(part: PixelSamples) -> Tensor:
        predicted = isp.reverse_pixels(part.srgb, colour.params(), part.place)
        error = (predicted.clamp_min(1e-5).sqrt() - part.target.clamp_min(1e-5).sqrt()) ** 2 * part.known
        return (error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)).mean()

    _descend(loss, parameters, samples, config, "fit sRGB -> RAW" if progress else "")
    colour.log_scale.requires_grad_(False)
    colour.matrix.requires_grad_(False)


def _refine_forward(
    isp: DictionaryISP, colour: FrameColour, samples: PixelSamples, config: FitConfig, progress: bool
) -> None:
    """Step 5: the forward tone, gamma and attention, with the reverse pass's colours."""
    networks = isp.forward_networks
    networks.gamma.data.copy_(isp.reverse_networks.gamma)
    params = colour.params()
    parameters = [*networks.tone.parameters(), networks.gamma, *networks.attention.parameters()]

    def loss(part: PixelSamples) -> Tensor:
        seen: dict[str, Tensor] = {}
        predicted = isp.forward_pixels(part.cell_raw, params, part.place, seen)
        with torch.no_grad():
            reverse_x1 = isp.reverse_networks.tone(part.cell_srgb)
        error = (predicted - part.cell_srgb) ** 2 + 0.1 * (seen["x1"] - reverse_x1) ** 2
        return (error * part.cell_weight).sum() / (3.0 * part.cell_weight.sum()).clamp_min(1.0)

    _descend(loss, parameters, samples, config, "fit RAW -> sRGB" if progress else "")


def _descend(
    loss: Callable[[PixelSamples], Tensor],
    parameters: Sequence[Tensor],
    samples: PixelSamples,
    config: FitConfig,
    label: str,
) -> None:
    """Adam with a cosine on random pixels; ``label`` heads the progress bar, empty for none."""
    generator = keyed_generator(config.seed, "refine")
    optimiser = torch.optim.Adam(parameters, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, config.steps))
    pixels = samples.srgb.shape[-1]
    for _ in (bar := tqdm(range(config.steps), desc=label, disable=not label, unit="step", leave=False)):
        part = samples.pick(torch.randint(pixels, (min(config.batch, pixels),), generator=generator))
        value = loss(part)
        optimiser.zero_grad(set_to_none=True)
        value.backward()
        optimiser.step()
        schedule.step()
        bar.set_postfix_str(f"loss {value.item():.2e}", refresh=False)


@torch.no_grad()
def _set_atoms(isp: DictionaryISP, colour: FrameColour, seed: int) -> None:
    """Step 3: the frames' colours, or their cluster centres, become the atoms."""
    matrix, gains = colour.params().matrix, colour.params().gains
    isp.colour.matrices.copy_(_centres(matrix.flatten(1), isp.config.colour_atoms, seed).unflatten(1, (3, 3)))
    red, green, blue = _centres(gains.log(), isp.config.gain_atoms, seed).unbind(1)
    isp.gain.log_gains.copy_(torch.stack([green, red - green, blue - green], dim=1))


def _centres(points: Tensor, count: int, seed: int) -> Tensor:
    """``(F, D)`` to ``(count, D)``: the points themselves if there are as many, else k-means centres."""
    if len(points) == count:
        return points
    from scipy.cluster.vq import kmeans2

    centres, _ = kmeans2(points.double().numpy(), count, minit="++", rng=derived_seed(seed, "atoms") % 2**32)
    return torch.from_numpy(centres).float()


def _set_priors(isp: DictionaryISP, samples: PixelSamples, colour: FrameColour, steps: int = 400) -> None:
    """Step 4: the constant weights, from second moments of the unbalanced image against the readings."""
    colour_weights = torch.full((isp.config.colour_atoms,), 1.0 / isp.config.colour_atoms)
    with torch.no_grad():
        matrix = isp.colour.combine(colour_weights[None]).expand(len(samples.srgb), 3, 3)
        x = stages.correct_colour(_linear(isp, samples, colour), matrix)
        a, b, c = ((samples.known * m).mean((2, 3)) for m in (x * x, x * samples.target, samples.target**2))
    inverse_atoms = 1.0 / isp.gain.channel_gains().detach()
    logits = torch.zeros(isp.config.gain_atoms, requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.05)
    for _ in range(steps):
        u = logits.softmax(0) @ inverse_atoms
        loss = ((u * u * a - 2 * u * b + c).sum(1) + LOG_MSE_EPS).log().sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    for networks in (isp.reverse_networks, isp.forward_networks):
        networks.colour_encoder.set_prior(colour_weights)
        networks.gain_encoder.set_prior(logits.detach().softmax(0))
