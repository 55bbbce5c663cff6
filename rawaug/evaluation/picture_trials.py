r"""Real pairs of developed pictures as trials, both as published and with the truth registered to the shot.

.. math:: c'_k = a_k\, c_k(p - t) + b_k

The mean of many shots lies up to half a pixel from the shot that is scored, and differs from it by codes in brightness,
which no denoiser can know. Phase correlation gives t; least squares give a and b of each colour. All are found between
the noisy picture and the clean one, so that they do not depend on the denoiser. A border is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.data.picture_pairs import PicturePair
from rawaug.errors import count_of, extra
from rawaug.evaluation.scores import NOISY, ScoredDenoiser, group_rows, score, summary
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial, make_trials

PUBLISHED, REGISTERED = "as published", "registered"
_BORDER = 4
"""Width of the border that is left out of the scores, in pixels."""


def picture_trials(pairs: Sequence[Any], registered: bool = False) -> Sequence[Trial]:
    """Make a trial in the domain ``srgb`` from every pair."""

    def make(pair: PicturePair) -> Trial:
        noisy, clean = pair.noisy[None] / 255.0, pair.clean[None] / 255.0
        if not registered:
            return Trial(noisy, clean, frame=pair.name, domain="srgb", condition=PUBLISHED)

        inner = (..., slice(_BORDER, -_BORDER), slice(_BORDER, -_BORDER))
        moved = register(noisy[0], clean[0])[None]
        return Trial(noisy[inner], moved[inner], frame=pair.name, domain="srgb", condition=REGISTERED)

    return make_trials(pairs, make)


def register(noisy: Tensor, clean: Tensor) -> Tensor:
    """Move the clean picture ``(3, H, W)`` onto the noisy one, and match its gain and offset in each colour."""
    with extra("raw"):
        from skimage.registration import phase_cross_correlation
    from scipy.ndimage import shift

    offset, *_ = phase_cross_correlation(noisy.mean(0).numpy(), clean.mean(0).numpy(), upsample_factor=50)
    offset = np.clip(offset, -_BORDER + 1.0, _BORDER - 1.0)
    inner = slice(_BORDER, -_BORDER), slice(_BORDER, -_BORDER)

    planes = []
    for shot, truth in zip(noisy.double().numpy(), clean.double().numpy(), strict=True):
        plane = shift(truth, offset, order=3, mode="nearest")
        if np.ptp(plane) > 0.02:  # a flat plane has no gain
            gain, level = np.polyfit(plane[inner].ravel(), shot[inner].ravel(), 1)
            plane = gain * plane + level
        planes.append(plane)

    return torch.from_numpy(np.stack(planes)).float().clamp(0.0, 1.0)


def picture_scores(denoisers: Sequence[ScoredDenoiser], pairs: Sequence[Any]) -> dict[str, Any]:
    """Score every denoiser on pairs of pictures: ``rows`` by name and condition, as in ``rawaug evaluate --json``."""
    rows: dict[str, dict[str, Any]] = {}
    for condition in (PUBLISHED, REGISTERED):
        trials = picture_trials(pairs, registered=condition == REGISTERED)
        rows_by_name = group_rows(score([NOISY, *denoisers], trials, condition))
        for name, of_one in rows_by_name.items():
            rows.setdefault(name, {})[condition] = summary(of_one, rows_by_name[NOISY.name])

    return {"pictures": len(pairs), "rows": rows}


def print_pictures(data: str, result: Mapping[str, Any]) -> None:
    """Print the table of :func:`picture_scores`."""
    rows = []
    for name, by_condition in result["rows"].items():
        cells = [name]
        for condition in (PUBLISHED, REGISTERED):
            scores = by_condition[condition]
            cells.append(f"{scores['psnr']:.2f} / {scores['ssim']:.4f}")
        rows.append(cells)

    title = f"PSNR in dB / SSIM, {data}, {count_of(result['pictures'], 'picture')}"
    print_rows(title, ["denoiser", PUBLISHED, REGISTERED], rows)
