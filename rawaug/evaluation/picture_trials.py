r"""Real pairs of developed pictures as trials, as they are published and with the truth registered to the shot.

.. math:: c'_k = a_k\, c_k(p - t) + b_k

The mean of many shots lies up to half a pixel from the one that is scored, and differs from it by codes in brightness,
which no denoiser can know. t is found by phase correlation, a and b of each colour by least squares, all of them
between the noisy picture and the clean one, so that they do not depend on the denoiser. A border is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.data.picture_pairs import PicturePair, open_picture_pairs
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.errors import extra
from rawaug.evaluation.comparison import Comparison
from rawaug.evaluation.evaluate import Evaluation
from rawaug.evaluation.scores import NOISY, Denoiser, group_rows, score, summary
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial, make_trials
from rawaug.files import write_json
from rawaug.version import __version__

PUBLISHED, REGISTERED = "as published", "registered"
BORDER = 4
"""Width of the border that is left out of the scores, in pixels."""


def picture_trials(pairs: Sequence[Any], registered: bool = False) -> Sequence[Trial]:
    """A trial in the domain ``srgb`` of every pair."""

    def make(pair: PicturePair) -> Trial:
        noisy, clean = pair.noisy[None] / 255.0, pair.clean[None] / 255.0
        if not registered:
            return Trial(noisy, clean, frame=pair.name, domain="srgb", condition=PUBLISHED)
        inner = (..., slice(BORDER, -BORDER), slice(BORDER, -BORDER))
        moved = register(noisy[0], clean[0])[None]
        return Trial(noisy[inner], moved[inner], frame=pair.name, domain="srgb", condition=REGISTERED)

    return make_trials(pairs, make)


def register(noisy: Tensor, clean: Tensor) -> Tensor:
    """The clean picture ``(3, H, W)`` moved onto the noisy one, with its gain and offset in each colour."""
    with extra("raw"):
        from skimage.registration import phase_cross_correlation
    from scipy.ndimage import shift

    found = phase_cross_correlation(noisy.mean(0).numpy(), clean.mean(0).numpy(), upsample_factor=50)[0]
    step = np.clip(found, -BORDER + 1.0, BORDER - 1.0)
    planes = []
    for shot, truth in zip(noisy.double().numpy(), clean.double().numpy(), strict=True):
        moved = shift(truth, step, order=3, mode="nearest")
        inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
        gain, offset = np.polyfit(moved[inner].ravel(), shot[inner].ravel(), 1) if np.ptp(moved) > 0.02 else (1.0, 0.0)
        planes.append(gain * moved + offset)
    return torch.from_numpy(np.stack(planes)).float().clamp(0.0, 1.0)


def picture_scores(denoisers: Sequence[Denoiser], pairs: Sequence[Any]) -> dict[str, Any]:
    """Every denoiser on pairs of pictures: ``rows`` by its name and by condition, as of ``rawaug evaluate --json``."""
    rows: dict[str, dict[str, Any]] = {}
    for condition in (PUBLISHED, REGISTERED):
        trials = picture_trials(pairs, registered=condition == REGISTERED)
        found = group_rows(score([NOISY, *denoisers], trials, condition))
        for name, of_one in found.items():
            rows.setdefault(name, {})[condition] = summary(of_one, found[NOISY.name])
    return {"pictures": len(pairs), "rows": rows}


def print_pictures(data: str, result: Mapping[str, Any]) -> None:
    """The table of :func:`picture_scores`."""
    rows = []
    for name, by_condition in result["rows"].items():
        cells = [name]
        for condition in (PUBLISHED, REGISTERED):
            scores = by_condition[condition]
            cells.append(f"{scores['psnr']:.2f} / {scores['ssim']:.4f}")
        rows.append(cells)

    title = f"PSNR in dB / SSIM, {data}, {result['pictures']} pictures"
    print_rows(title, ["denoiser", PUBLISHED, REGISTERED], rows)


def evaluate_pictures(asked: Evaluation) -> dict[str, Any]:
    """Score a denoiser of pictures, beside classical filters; the result, as in the JSON.

    ``plain`` holds the result with the default number of views, where more are asked for.
    """
    if asked.noise is not None or asked.bin != 1 or asked.report:
        raise ValueError(f"{asked.data}: has developed pictures; --noise, --bin and --report are for RAW")

    plain = PictureDenoiser.of(asked.denoiser, asked.device)
    filters = [PictureDenoiser.of(spec) for spec in asked.classical]
    denoisers = [plain, *filters]
    main = plain
    if asked.views > 1:
        main = replace(plain, name=f"{plain.name}, {asked.views} views", views=asked.views)
        denoisers.insert(1, main)

    pairs = open_picture_pairs(asked.data, asked.settings.noisy, asked.settings.clean)
    scores = picture_scores(denoisers, pairs)
    print_pictures(asked.data, scores)

    rows = scores["rows"]
    result = {
        "kind": "denoiser",
        "data": asked.data,
        "version": __version__,
        **rows[main.name][PUBLISHED],
        "registered": rows[main.name][REGISTERED],
    }
    if asked.views > 1:
        result |= {"self_ensemble": True, "views": asked.views, "plain": rows[plain.name][PUBLISHED]}
    if filters:
        result["classical"] = {one.name: rows[one.name] for one in filters}

    asked.write(result)
    return result


def compare_pictures(asked: Comparison) -> None:
    """Compare denoisers of pictures; the table is printed, and written as JSON."""
    denoisers = [PictureDenoiser.of(spec, asked.device) for spec in asked.denoisers]
    result = picture_scores(denoisers, open_picture_pairs(asked.data))
    print_pictures(asked.data, result)
    if asked.json:
        write_json({"data": asked.data, **result}, asked.json)
