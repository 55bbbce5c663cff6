r"""End-to-end training, as in the paper, of an ISP that is already fitted.

``L = |y_hat - y|^2 + |x_hat - x|^2 + 0.1 sum_k |x_k^f - x_k^r|^2 + 0.01 |w_r - w_f|^2`` on random pixels of random
frames; both passes use the weights that their own encoders choose. A tenth of the frames is left out and watched: the
parameters come back that served these best, which may be those of the start.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.isp.fit.descent import Descent
from rawaug.isp.fit.fit_config import FitConfig
from rawaug.isp.fit.losses import apart, cycle_error, decibels, mean_square
from rawaug.isp.fit.samples import PixelSamples, Shot
from rawaug.isp.model import DictionaryISP

MANY_FRAMES = 50
STEPS = 1000
FRAMES_A_STEP = 4
LEARNING_RATE = 2e-4
CONSISTENCY = 0.01


def joint_steps(config: FitConfig, frames: int) -> int:
    """How long a number of frames is trained jointly."""
    if config.joint_steps is not None:
        return config.joint_steps
    return STEPS if frames >= MANY_FRAMES else 0


def train_jointly(
    isp: DictionaryISP,
    samples: PixelSamples,
    shots: Sequence[Shot],
    config: FitConfig,
    descent: Descent,
    learning_rate: float = LEARNING_RATE,
) -> None:
    """Refine everything at once, if ``config.joint_steps`` says so; the gain goes to ``isp.info``."""
    steps = joint_steps(config, len(shots))
    if steps == 0:
        return
    if len(shots) < 2:
        raise ValueError("joint_steps: end-to-end training holds frames out for validation; give two frames or more")
    watched = list(range(0, len(shots), 10))[: max(1, len(shots) // 2)]
    trained = [k for k in range(len(shots)) if k not in watched]

    def loss(generator: torch.Generator) -> Tensor:
        chosen = torch.randint(len(trained), (FRAMES_A_STEP,), generator=generator).tolist()
        pixels = torch.randint(samples.srgb.shape[-1], (config.batch,), generator=generator)
        return torch.stack([_frame_loss(isp, samples, shots, trained[k], pixels, config) for k in chosen]).mean()

    def watch() -> float:
        return decibels(isp, samples, shots, watched)

    descent.run("end to end", loss, dict(isp.named_parameters()), steps, learning_rate, watch=watch)
    seen = descent.watched["end to end"]
    isp.info["joint"] = {"steps": steps, "kept_step": seen.step, "gain_db": round(seen.best - seen.start, 2)}


def _frame_loss(
    isp: DictionaryISP, samples: PixelSamples, shots: Sequence[Shot], frame: int, pixels: Tensor, config: FitConfig
) -> Tensor:
    part = samples.pick(pixels, torch.tensor([frame]))
    ours, theirs = isp.choose(shots[frame].srgb), isp.choose_forward(isp.unshaded(shots[frame].raw, None))
    back: dict[str, Tensor] = {}
    back["raw"] = isp.reverse_pixels(part.cell_srgb, ours, part.place, back)
    cycle = cycle_error(isp, part, theirs, back, config)
    return mean_square(isp, part, ours)[0] + cycle + CONSISTENCY * config.consistency * apart(ours, theirs)
