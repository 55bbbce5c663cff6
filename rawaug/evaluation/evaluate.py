"""The scores of one denoiser on a test set, beside classical filters, and the facts that stand beside scores."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import NOISY, Row, group_rows, score, summary
from rawaug.evaluation.trials import Trial
from rawaug.files import sha256
from rawaug.version import __version__


def evaluation_facts(kind: str, data: str, file: Path | None = None, bin: int = 1) -> dict[str, Any]:
    """State the facts of a result besides scores: the kind of weights, denoiser or isp, their file's hash, ..."""
    facts: dict[str, Any] = {"kind": kind, "data": data}
    if file is not None:
        facts["weights_sha256"] = sha256(file)
    facts["version"] = __version__
    if bin != 1:
        facts["bin"] = bin

    return facts


def evaluate_raw(
    denoiser: RawDenoiser, filters: Sequence[RawDenoiser], trials: Sequence[Trial], views: int = 1
) -> Iterator[dict[str, Any]]:
    """Yield the scores of a denoiser of RAW as JSON: first the plain ones; then all, since the others take longer.

    Args:
        denoiser: the denoiser.
        filters: filters to score as well, in ``classical``.
        trials: the test frames with their noise.
        views: 1, or 4 or 8 to score the self-ensemble, too; the plain scores are then in ``plain``.

    Raises:
        ValueError: if a score is NaN, as damaged weights give at their first frame.
    """
    noisy, plain = group_rows(_finite_rows([NOISY, denoiser], trials, "evaluate")).values()
    result: dict[str, Any] = {"self_ensemble": False, **summary(plain, noisy)}
    yield result

    compared = list(filters)
    if views > 1:
        compared.insert(0, replace(denoiser, name="views", views=views))
    if not compared:
        return

    rows = group_rows(_finite_rows(compared, trials, "evaluate, the rest"))
    if views > 1:
        about = {"self_ensemble": True, "views": views, "plain": summary(plain, noisy)}
        result = {**about, **summary(rows.pop("views"), noisy)}
    for name, of_filter in rows.items():
        result.setdefault("classical", {})[name] = summary(of_filter, noisy)
    yield result


def _finite_rows(denoisers: Sequence[Any], trials: Sequence[Trial], label: str) -> Iterator[Row]:
    for row in score(denoisers, trials, label):
        require_finite(row.frame, row.psnr)
        yield row


def require_finite(frame: str, value: float) -> float:
    """Return the score of a frame; ValueError if it is NaN, which means that the weights are damaged."""
    if math.isnan(value):
        raise ValueError(f"{frame}: the result is not finite; the weights are damaged")

    return value


def named_denoiser(spec: str, device: str = "cpu") -> RawDenoiser:
    """Open the denoiser that the command line names; only here is ``package.module:function`` imported."""
    module, colon, function = spec.partition(":")
    if not colon or Path(spec).suffix in (".onnx", ".safetensors"):
        return RawDenoiser.of(spec, device)

    sys.path.insert(0, str(Path.cwd()))  # as python -m does
    try:
        denoiser = getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{spec}: cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)

    return RawDenoiser.of(denoiser, device, name=spec)
