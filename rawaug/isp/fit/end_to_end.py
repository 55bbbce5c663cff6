r"""What a fit learns last, and keeps as far as frames that were left out gain: encoders, and everything at once.

*Encoders* are trained with tone and dictionaries frozen, on the RAW that either direction's weights make:
``L = sum_f log(MSE_f(w_r) + eps) + log(MSE_f(w_f) + eps) + c |w_r - w_f|^2``. For every fold, curve, tone and atoms are
fitted anew without its frames, then constants and encoders are compared on these.

*End-to-end training* refines an ISP that is already fitted:
``L = |y_hat - y|^2 + |x_hat - x|^2 + 0.1 sum_k |x_k^f - x_k^r|^2 + 0.01 |w_r - w_f|^2`` on random pixels of random
frames, with the weights that both encoders choose. A tenth of the frames is watched, and the best parameters are
restored. Source: Conde et al., AAAI 2022, "Training".
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.fit.atoms import measure_lights
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.descent import Descent, cycle_error, frame_mse, mean_psnr
from rawaug.isp.fit.samples import FitFrames, FrameSummary, PixelSamples
from rawaug.isp.model import DictionaryISP

FRAMES_A_STEP = 4
ENCODER_PIXELS, ENCODER_RATE = 1024, 1e-3
FEWEST_FRAMES, FOLDS = 12, 4
"""For encoders with "auto": the minimum number of frames, and the number of folds of the cross-validation."""

_MANY_FRAMES = 50
"""Minimum number of frames for end-to-end training by default."""
STEPS, LEARNING_RATE = 1000, 2e-4
"""Number of steps, and learning rate, of end-to-end training."""
_CONSISTENCY = 0.01
"""Weight of the distance between the weights of both directions."""
PUBLISHED_RATE, PUBLISHED_FRAMES, _PUBLISHED_PIXELS = 2e-3, 8, 256
"""Rate of the published fit, which learns nearly everything end to end, and frames and pixels in a step."""
_LOG_WEIGHT = 0.02
"""Weight of the logarithm of an error beside the squared errors of the other pass."""
CURVE_POINTS = 13
"""Number of scores of a watched training in an ISP's record."""
_LOSS_SCALE = 1e4
"""Factor on squared errors: they are near 1e-4, and the encoders' share would vanish beside Adam's epsilon of 1e-8."""

Refit = Callable[[FitFrames, str, FitConfig], DictionaryISP]
"""A function that fits an ISP without encoders to some frames; the text names the fit in its progress."""


def gain_left_out(frames: FitFrames, gain: Callable[[FitFrames, FitFrames, str], float]) -> float:
    """Average ``gain(left out, kept, name of the fold)`` over the frames, each of which is left out once."""
    count = len(frames.shots)
    folds = min(FOLDS, count)
    total = 0.0
    for fold in range(folds):
        out, kept = frames.split(range(fold, count, folds))
        total += len(out.shots) * gain(out, kept, f" without part {fold + 1} of {folds}")

    return total / count


def train_encoders(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, refit: Refit) -> None:
    """Train the encoders, or keep the constants, as ``config.encoders`` says.

    Args:
        isp: the ISP, fitted up to its atoms.
        frames: all frames of the fit.
        config: the settings of the fit.
        descent: runs the training.
        refit: fits an ISP without encoders to some of the frames, to judge encoders on the others.
    """

    def better(out: FitFrames, kept: FitFrames, part: str) -> float:
        """Compute by how many dB encoders beat constants on frames that no stage of the fit has seen."""
        refitted = refit(kept, part, config)
        refitted.use_encoders(False)
        constants = mean_psnr(refitted, out)
        _train(refitted, kept, config, descent, f"encoders{part}")
        return mean_psnr(refitted, out) - constants

    mode = config.encoders
    isp.use_encoders(False)
    if mode == "auto" and len(frames.shots) >= FEWEST_FRAMES:
        gain = gain_left_out(frames, better)
        isp.info["encoders_gain_db"] = round(gain, 2)
        mode = "on" if gain > 0 else "off"

    if mode == "on":
        _train(isp, frames, config, descent, "encoders")


def _train(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, stage: str) -> None:
    isp.use_encoders(True, descent.seed)
    tensors = {}
    for name, parameter in isp.named_parameters():
        if "_encoders." in name and ".layers." in name:
            tensors[name] = parameter

    def loss(generator: torch.Generator) -> Tensor:
        # The frames of a step have the same random pixels.
        numbers = torch.randint(len(frames.shots), (FRAMES_A_STEP,), generator=generator).tolist()
        index = torch.randint(frames.pixels.srgb.shape[-1], (ENCODER_PIXELS,), generator=generator)

        losses = []
        for number in numbers:
            part, shot = frames.pixels.pick(index, torch.tensor([number])), frames.shots[number]
            losses.append(_encoder_loss(isp, part, shot, config, generator))
        return torch.stack(losses).mean()

    descent.run(stage, loss, tensors, config.encoder_steps, ENCODER_RATE)


def _encoder_loss(
    isp: DictionaryISP, part: PixelSamples, shot: FrameSummary, config: FitConfig, generator: torch.Generator
) -> Tensor:
    srgb, raw = _same_piece(shot.srgb, isp.stages.remove_shading(shot.raw, None), generator)
    ours, theirs = isp.choose(srgb), isp.choose_forward(raw)
    our_error = (frame_mse(isp, part, ours) + config.mse_floor).log()
    their_error = (frame_mse(isp, part, theirs) + config.mse_floor).log()
    return (our_error + their_error).sum() + config.consistency * _weight_distance(ours, theirs)


def _weight_distance(ours: ISPParams, theirs: ISPParams) -> Tensor:
    """Compute ``|w_r - w_f|^2``, the sum over both dictionaries, a scalar."""
    colour = (ours.colour_weights - theirs.colour_weights).square().sum()
    return colour + (ours.gain_weights - theirs.gain_weights).square().sum()


def _same_piece(srgb: Tensor, raw: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Cut the same random piece from both thumbnails, maybe flipped, so that the encoders cannot learn the frames."""
    share = 0.5 + 0.5 * torch.rand(2, generator=generator)
    start = torch.rand(2, generator=generator) * (1.0 - share)
    flip = bool(torch.rand((), generator=generator) < 0.5)
    pieces = []
    for image in (srgb, raw):
        sides = torch.tensor(image.shape[-2:])
        top, left = (start * sides).long().tolist()
        height, width = (share * sides).long().clamp_min(1).tolist()
        piece = image[..., top : top + height, left : left + width]
        pieces.append(piece.flip(-1) if flip else piece)

    return pieces[0], pieces[1]


def joint_steps(config: FitConfig, frames: int) -> int:
    """The number of steps of end-to-end training on this number of frames."""
    if config.joint_steps is not None:
        return config.joint_steps
    return STEPS if frames >= _MANY_FRAMES else 0


def train_jointly(
    isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, watched: FitFrames | None = None
) -> FitFrames | None:
    """Refine everything at once, if ``config.joint_steps`` asks for it; the gain is noted in ``isp.info``.

    The properties of the atoms that as-shot gains depend on are measured anew afterwards.

    Args:
        isp: the fitted ISP.
        frames: all frames of the fit.
        config: the settings of the fit.
        descent: runs the training.
        watched: frames that choose the best step; by default a tenth of the others, which is held out.

    Returns:
        The watched frames; None without a training.
    """
    count = len(frames.shots)
    steps = joint_steps(config, count)
    if steps == 0:
        return None
    if watched is None and count < 2:
        raise ValueError("joint_steps: end-to-end training holds frames out for validation; give two frames or more")

    trained = frames
    if watched is None:
        watched, trained = frames.split(range(0, count, 10)[: max(1, count // 2)])

    published = config.method == "published"
    frames_a_step, pixels, rate = FRAMES_A_STEP, config.batch, LEARNING_RATE
    if published:
        frames_a_step, pixels, rate = PUBLISHED_FRAMES, min(config.batch, _PUBLISHED_PIXELS), PUBLISHED_RATE

    def loss(generator: torch.Generator) -> Tensor:
        losses = []
        for part, srgb, raw in _draw_batches(trained, frames_a_step, pixels, generator):
            raw = isp.stages.remove_shading(raw, None)
            if published:
                srgb, raw = _same_piece(srgb, raw, generator)

            losses.append(len(srgb) * _joint_loss(isp, part, srgb, raw, config))

        return _LOSS_SCALE * torch.stack(losses).sum() / frames_a_step

    tensors = dict(isp.named_parameters())
    descent.run("end to end", loss, tensors, steps, rate, watch=lambda: mean_psnr(isp, watched))

    step, score = descent.best("end to end")
    if step > 0:
        measure_lights(isp, trained)
    scores = [score for _, score in descent.scores["end to end"]]
    points = min(CURVE_POINTS, len(scores))
    curve = []
    for k in range(points):  # with the first and the last
        number = round(k * (len(scores) - 1) / max(1, points - 1))
        curve.append(round(scores[number], 2))

    isp.info["joint"] = {
        "steps": steps,
        "kept_step": step,
        "gain_db": round(score - scores[0], 2),
        "curve": curve,
    }
    return watched


def _draw_batches(
    frames: FitFrames, count: int, pixels: int, generator: torch.Generator
) -> list[tuple[PixelSamples, Tensor, Tensor]]:
    """Draw ``count`` frames, with replacement, in batches of one size: pixels, thumbnails of sRGB and of RAW."""
    numbers = torch.randint(len(frames.shots), (count,), generator=generator).tolist()
    index = torch.randint(frames.pixels.srgb.shape[-1], (pixels,), generator=generator)
    groups: dict[tuple[torch.Size, torch.Size], list[int]] = {}
    for k in numbers:
        shot = frames.shots[k]
        groups.setdefault((shot.srgb.shape, shot.raw.shape), []).append(k)

    batches = []
    for members in groups.values():
        shots = [frames.shots[k] for k in members]
        srgb = torch.cat([shot.srgb for shot in shots])
        raw = torch.cat([shot.raw for shot in shots])
        batches.append((frames.pixels.pick(index, torch.tensor(members)), srgb, raw))

    return batches


def _joint_loss(isp: DictionaryISP, part: PixelSamples, srgb: Tensor, raw: Tensor, config: FitConfig) -> Tensor:
    """Compute the loss of B frames: ``srgb`` ``(B, 3, h, w)`` and ``raw`` ``(B, 3, h', w')``, without shading."""
    ours, theirs = isp.choose(srgb), isp.choose_forward(raw)
    back: dict[str, Tensor] = {}
    back["raw"] = isp.stages.reverse(part.cell_srgb, ours, part.coordinates, back)
    cycle = cycle_error(isp, part, theirs, back, config)
    distance = _weight_distance(ours, theirs) / len(srgb)
    error = frame_mse(isp, part, ours)
    if config.raw_loss == "log":
        error = _LOG_WEIGHT * (error + config.mse_floor).log()
    return error.mean() + cycle + _CONSISTENCY * config.consistency * distance
