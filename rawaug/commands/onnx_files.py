"""ONNX files of modules whose pictures may have any size, and how they are run here."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

TOLERANCE = 1e-4
"""Largest difference between ONNX Runtime and PyTorch, white at 1."""
NEEDED = ("onnx", "onnxscript", "onnxruntime")


def require_onnx(way_out: str = "") -> None:
    """Raise ValueError if a package that writes or runs ONNX is missing; ``way_out`` ends the message."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ValueError(f"export to ONNX needs {', '.join(missing)}: pip install 'rawaug[export]'{way_out}")


def to_onnx(model: nn.Module, inputs: dict[str, Tensor], output: str, path: Path) -> None:
    """One ONNX file of float32; height and width of four-dimensional inputs are free.

    Args:
        model: called with the inputs in order.
        inputs: by name, of a typical size.
        output: its name.
        path: the file.
    """
    free = {2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC}
    with warnings.catch_warnings(), errors_only("torch.onnx"):  # not the exporter's own, as of torchvision's absence
        warnings.simplefilter("ignore")
        shapes = tuple(free if value.ndim == 4 else None for value in inputs.values())
        program = torch.export.export(model, tuple(inputs.values()), dynamic_shapes=shapes)
        onnx = torch.onnx.export(program, input_names=list(inputs), output_names=[output], dynamo=True, verbose=False)
        assert onnx is not None
        onnx.save(str(path), external_data=False)


@contextmanager
def errors_only(name: str) -> Iterator[None]:
    """A logger and those below it say nothing less than an error."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def session_of(path: Path) -> Any:
    """ONNX Runtime on the CPU, on as many threads as PyTorch has."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def feeds(names: Sequence[str], values: Sequence[Tensor]) -> dict[str, Any]:
    """What a session is run with."""
    return {name: value.numpy() for name, value in zip(names, values, strict=True)}


def require_equal(result: Any, expected: Tensor, path: Path) -> float:
    """The largest difference between ONNX Runtime's result and PyTorch's.

    Raises:
        ValueError: if it is above :data:`TOLERANCE`, or not a number.
    """
    difference = (torch.from_numpy(result) - expected).abs().max().item()
    if not difference <= TOLERANCE:
        raise ValueError(f"{path}: ONNX Runtime differs from PyTorch by {difference:.1e}, more than {TOLERANCE}")
    return difference
