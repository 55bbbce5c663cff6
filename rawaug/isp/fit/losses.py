r"""What the stages of a fit minimise, and what frames left out are judged by.

The loss on RAW is ``(y_hat - y)^2 / (4 (y_hat + 0.01))``, with the denominator taken as a constant: shot noise makes
the error of a reading proportional to its square root, and weights that do not depend on ``y`` keep noise unbiased.
The loss on sRGB takes in the images between the stages (Conde et al., AAAI 2022, "Training").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rawaug.isp.conditioning import with_white_balance
from rawaug.isp.fit.fit_config import FitConfig
from rawaug.isp.fit.samples import PixelSamples, Shot
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams


def reading_error(predicted: Tensor, part: PixelSamples) -> Tensor:
    """Mean over frames of the weighted squared error on unclipped readings."""
    weight = part.known / (4.0 * (predicted.detach().clamp_min(0.0) + 0.01))
    error = (predicted - part.target) ** 2 * weight
    return (error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)).mean()


def cycle_error(
    isp: DictionaryISP, part: PixelSamples, params: ISPParams, back: Mapping[str, Tensor], config: FitConfig
) -> Tensor:
    """l2 on the sRGB of the forward pass, and on every intermediate image against ``back``, the reverse pass's.

    From noisy readings the pass would learn to mend noise, so that it starts where the reverse pass ended.
    """
    ahead: dict[str, Tensor] = {}
    start = back["raw"].detach() if config.noisy else part.cell_raw
    error = (isp.forward_pixels(start, params, part.place, ahead) - part.cell_srgb) ** 2
    for name in ahead:
        error = error + config.intermediate * (ahead[name] - back[name]) ** 2 if name in back else error
    return (error * part.cell_weight).sum() / (3.0 * part.cell_weight.sum()).clamp_min(1.0)


def mean_square(isp: DictionaryISP, part: PixelSamples, params: ISPParams) -> Tensor:
    """Error of every frame ``(F,)`` on its unclipped pixels."""
    count = len(part.srgb)
    params = ISPParams(*(value.expand(count, *value.shape[1:]) for value in params))
    error = (isp.reverse_pixels(part.srgb, params, part.place) - part.target) ** 2 * part.known
    return error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)


def apart(ours: ISPParams, theirs: ISPParams) -> Tensor:
    """``|w_r - w_f|^2`` of both dictionaries."""
    colour = (ours.colour_weights - theirs.colour_weights).square().sum()
    return colour + (ours.gain_weights - theirs.gain_weights).square().sum()


@torch.no_grad()
def decibels(
    isp: DictionaryISP, samples: PixelSamples, shots: Sequence[Shot], frames: Sequence[int], as_shot: bool = False
) -> float:
    """Mean PSNR of some frames, each under the parameters that the ISP chooses for its thumbnail.

    Args:
        isp: the ISP.
        samples, shots: all frames.
        frames: which of them.
        as_shot: with the gains that their files state.
    """
    every, values = torch.arange(samples.srgb.shape[-1]), []
    for k in frames:
        given = shots[k].white_balance if as_shot else None
        params = with_white_balance(isp, isp.choose(shots[k].srgb), given, None)
        values.append(mean_square(isp, samples.pick(every, torch.tensor([k])), params))
    return float(-10.0 * torch.cat(values).log10().mean())
