r"""The oracle of the reconstruction table: the setting of an ISP that comes closest to a frame's RAW.

.. math:: \min_{w, v, g} \; \log \bigl( \| y - f^{-1}(x; w, v, g) \|^2 / P + \epsilon \bigr)

over the weights of the atoms and, for an ISP of published cameras, the gains, which there follow from any light. There
the problem is convex in each of the three alone, not in all of them, so that descent starts where alternating least
squares end (:mod:`rawaug.isp.conditioning`), with all P pixels for readings. A fitted ISP's gains stay within the hull
of its own, and descent starts from the middle of the hulls. The settings of rows that know less are compared as well:
none of them is better than the oracle.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.data.pair import Pair
from rawaug.isp import conditioning
from rawaug.isp.fit.samples import PixelSamples, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams

PIXELS = 16384
STEPS = 300
RATE = 0.1
LOG_RATE = 0.01
"""Of log gains, which start near their end."""
EPS = 1e-9
FLOOR = 1e-3
"""Added to weights before their logarithm, or an atom that starts at 0 stays there."""


@torch.no_grad()
def oracle(isp: DictionaryISP, pair: Pair, others: Sequence[ISPParams]) -> ISPParams:
    """The best setting for the frame among what descent finds and the ``others``, one or more."""
    pixels, _ = sample_pixels([pair], PIXELS, seed=0)
    start = None
    if isp.config.cameras:
        own, value = pixels.site[:, :, 0], pixels.target.sum(dim=(1, 2))
        start = conditioning.with_readings(isp, pixels.srgb, pixels.place, own, value, others[0])
    found = [*others, _descended(isp, pixels, start)]
    return min(found, key=lambda setting: squared_error(isp, pixels, setting).item())


def squared_error(isp: DictionaryISP, pixels: PixelSamples, setting: ISPParams) -> Tensor:
    """Mean over the readings that are not clipped: a few that are would outweigh all others. Held to [0, 1]."""
    made = isp.reverse_pixels(pixels.srgb, setting, pixels.place).clamp(0.0, 1.0)
    return ((made - pixels.target) ** 2 * pixels.known).sum() / pixels.known.sum()


@torch.enable_grad()
def _descended(isp: DictionaryISP, pixels: PixelSamples, start: ISPParams | None) -> ISPParams:
    """From ``start``, with free gains; or from uniform weights of all atoms, those of the gains among them."""
    config = isp.config
    if start is None:
        logits = [torch.zeros(1, n) for n in (config.colour_atoms, config.gain_atoms, config.tone_atoms) if n]
        log_gains = torch.zeros(0)
    else:
        logits = [(weights + FLOOR).log() for weights in (start.colour_weights, start.tone_weights) if weights.shape[1]]
        log_gains = start.gains.log()
    logits, log_gains = [value.clone().requires_grad_() for value in logits], log_gains.clone().requires_grad_()

    def setting() -> ISPParams:
        weights = [value.softmax(dim=1) for value in logits]
        if start is None:
            return isp.params_from_weights(*weights)
        tones = weights[1] if len(weights) > 1 else start.tone_weights
        return ISPParams(weights[0], start.gain_weights[:, :0], isp.colour.combine(weights[0]), log_gains.exp(), tones)

    optimiser = torch.optim.Adam([{"params": logits, "lr": RATE}, {"params": [log_gains], "lr": LOG_RATE}])
    best, least = setting(), torch.inf
    for _ in range(STEPS):
        tried = setting()
        error = squared_error(isp, pixels, tried)
        if error.item() < least:
            best, least = tried, error.item()
        optimiser.zero_grad()
        (error + EPS).log().backward()
        optimiser.step()
    return ISPParams(*(value.detach() for value in best))
