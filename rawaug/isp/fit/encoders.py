"""Training of the encoders and of everything at once, each kept only if frames that were left out say that it helps.

*Encoders* are trained last, with tone and dictionaries frozen, on the RAW that either direction's weights make:
``L = sum_f log(MSE_f(w_r) + eps) + log(MSE_f(w_f) + eps) + c |w_r - w_f|^2`` (Conde et al., AAAI 2022, "Training").
For every fold, curve, tone and atoms are fitted anew without its frames, then constants and encoders compared on these.

*End-to-end training* refines an ISP that is already fitted:
``L = |y_hat - y|^2 + |x_hat - x|^2 + 0.1 sum_k |x_k^f - x_k^r|^2 + 0.01 |w_r - w_f|^2`` on random pixels of random
frames, by the weights that both encoders choose. A tenth of the frames is watched: the best parameters come back.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.descent import Descent, cycle_error, mean_psnr, mean_square, weight_distance
from rawaug.isp.fit.samples import FitFrames, FrameSummary, PixelSamples
from rawaug.isp.model import DictionaryISP

FRAMES_A_STEP = 4
ENCODER_PIXELS, ENCODER_RATE = 1024, 1e-3
FEWEST_FRAMES, FOLDS = 12, 4
"""From so many frames on "auto" trains encoders; and parts that are left out in turn to judge them."""
MANY_FRAMES, STEPS, LEARNING_RATE, CONSISTENCY = 50, 1000, 2e-4, 0.01
"""End-to-end training: frames from which on it is the default, its steps, its rate, and the weight of consistency."""

Refit = Callable[[FitFrames, str, FitConfig], DictionaryISP]
"""Fits an ISP without encoders to some frames alone; the text tells its stages from those of other fits."""


def gain_left_out(frames: FitFrames, folds: int, gain: Callable[[FitFrames, FitFrames, str], float]) -> float:
    """Mean over the frames of ``gain(left out, kept, name of the fold)``, every frame being left out once."""
    every, total = range(len(frames.shots)), 0.0
    for fold in range(folds):
        out = every[fold::folds]
        kept = frames.some([k for k in every if k not in out])
        total += len(out) * gain(frames.some(out), kept, f" without part {fold + 1} of {folds}")
    return total / len(every)


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
        """dB by which encoders beat constants on frames that no stage of the fit has seen."""
        other = refit(kept, part, config)
        other.use_encoders(False)
        constants = mean_psnr(other, out)
        _train(other, kept, config, descent, f"encoders{part}")
        return mean_psnr(other, out) - constants

    wanted = config.encoders
    isp.use_encoders(False)
    if wanted == "auto" and len(frames.shots) >= FEWEST_FRAMES:
        gain = gain_left_out(frames, FOLDS, better)
        isp.info["encoders_gain_db"] = round(gain, 2)
        wanted = "on" if gain > 0 else "off"
    if wanted == "on":
        _train(isp, frames, config, descent, "encoders")


def _train(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, stage: str) -> None:
    isp.use_encoders(True, descent.seed)
    tensors = {name: p for name, p in isp.named_parameters() if "_encoders." in name and ".layers." in name}

    def loss(generator: torch.Generator) -> Tensor:
        drawn = _draw_frames(frames, FRAMES_A_STEP, ENCODER_PIXELS, generator)
        return torch.stack([_frame_loss(isp, part, shot, config, generator) for part, shot in drawn]).mean()

    descent.run(stage, loss, tensors, config.encoder_steps, ENCODER_RATE)


def _draw_frames(
    frames: FitFrames, count: int, pixels: int, generator: torch.Generator
) -> list[tuple[PixelSamples, FrameSummary]]:
    """Draw ``count`` of the frames, with replacement, each with the same random pixels."""
    chosen = torch.randint(len(frames.shots), (count,), generator=generator).tolist()
    index = torch.randint(frames.pixels.srgb.shape[-1], (pixels,), generator=generator)
    return [(frames.pixels.pick(index, torch.tensor([k])), frames.shots[k]) for k in chosen]


def _frame_loss(
    isp: DictionaryISP, part: PixelSamples, shot: FrameSummary, config: FitConfig, generator: torch.Generator
) -> Tensor:
    srgb, raw = _same_piece(shot.srgb, isp.remove_shading(shot.raw, None), generator)
    ours, theirs = isp.choose(srgb), isp.choose_forward(raw)
    errors = [(mean_square(isp, part, params) + config.mse_floor).log() for params in (ours, theirs)]
    return (errors[0] + errors[1]).sum() + config.consistency * weight_distance(ours, theirs)


def _same_piece(srgb: Tensor, raw: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Cut the same random piece from both thumbnails, flipped or not, so that the encoders cannot learn the frames."""
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
    """The steps of end-to-end training on this number of frames."""
    if config.joint_steps is not None:
        return config.joint_steps
    return STEPS if frames >= MANY_FRAMES else 0


def train_jointly(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent) -> None:
    """Refine everything at once, if ``config.joint_steps`` says so; the gain goes to ``isp.info``.

    Args:
        isp: the fitted ISP.
        frames: all frames of the fit, of which a tenth is held out.
        config: the settings of the fit.
        descent: runs the training.
    """
    count = len(frames.shots)
    steps = joint_steps(config, count)
    if steps == 0:
        return
    if count < 2:
        raise ValueError("joint_steps: end-to-end training holds frames out for validation; give two frames or more")
    held_out = range(0, count, 10)[: max(1, count // 2)]
    watched, trained = frames.some(held_out), frames.some([k for k in range(count) if k not in held_out])

    def loss(generator: torch.Generator) -> Tensor:
        drawn = _draw_frames(trained, FRAMES_A_STEP, config.batch, generator)
        return torch.stack([_joint_frame_loss(isp, part, shot, config) for part, shot in drawn]).mean()

    tensors = dict(isp.named_parameters())
    descent.run("end to end", loss, tensors, steps, LEARNING_RATE, watch=lambda: mean_psnr(isp, watched))
    seen = descent.watched["end to end"]
    isp.info["joint"] = {"steps": steps, "kept_step": seen.step, "gain_db": round(seen.best - seen.start, 2)}


def _joint_frame_loss(isp: DictionaryISP, part: PixelSamples, shot: FrameSummary, config: FitConfig) -> Tensor:
    ours, theirs = isp.choose(shot.srgb), isp.choose_forward(isp.remove_shading(shot.raw, None))
    back: dict[str, Tensor] = {}
    back["raw"] = isp.reverse_pixels(part.cell_srgb, ours, part.coordinates, back)
    cycle = cycle_error(isp, part, theirs, back, config)
    return mean_square(isp, part, ours)[0] + cycle + CONSISTENCY * config.consistency * weight_distance(ours, theirs)
