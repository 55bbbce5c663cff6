"""Networks in ONNX files, computed by OpenVINO on the CPU where it is installed, and otherwise by ONNX Runtime.

``rawaug export`` writes ONNX that states the CFA and the stride. Any other ONNX file will do that takes noisy packed
RAW ``(1, 4, h, w)``, with or without its variance. If a file does something wrong, the error is one line that names it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rawaug.errors import extra
from rawaug.files import parse_object

STRIDE = 32
"""The stride of a network that states none."""


class OnnxNetwork(nn.Module):
    """A network in an ONNX file, which takes one picture after the other.

    OpenVINO compiles it in float32, once for each size of picture.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if ONNX Runtime refuses it, or it takes other inputs.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.session = open_session(path)
        self.names = [value.name for value in self.session.get_inputs()]
        if not 1 <= len(self.names) <= 2:
            names = ", ".join(self.names)
            raise ValueError(f"{path}: takes {names}; a denoiser takes noisy RAW, or noisy RAW and its variance")
        self.reads_variance = len(self.names) == 2
        self._runs: dict[tuple[int, ...], Callable[[dict[str, Any]], Any]] = {}

        metadata = dict(self.session.get_modelmeta().custom_metadata_map)
        self.info: dict[str, Any] = parse_object(metadata.get("info", "{}"))
        self.stride = STRIDE
        stride = metadata.get("stride", "")
        if stride.isdecimal() and int(stride) > 0:
            self.stride = int(stride)
        self.upscale = 2 if metadata.get("upscale") == "2" else 1

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise RAW ``(B, 4, h, w)`` on the CPU; raise ValueError with the library's reason if it fails."""
        results = []
        try:
            for index in range(len(noisy)):
                inputs = [noisy[index : index + 1]]
                if variance is not None:
                    inputs.append(variance[index : index + 1])
                result = self._run(feeds(self.names, inputs))
                results.append(torch.as_tensor(result))
        except Exception as error:  # ONNX Runtime has a class of its own for each reason
            raise ValueError(f"{self.path}: {' '.join(str(error).split())}") from None

        denoised = torch.cat(results)
        sides = [self.upscale * side for side in noisy.shape[-2:]]
        if denoised.ndim != 4 or list(denoised.shape[-2:]) != sides:
            got = f"{tuple(denoised.shape)} for {tuple(noisy.shape)}"
            raise ValueError(f"{self.path}: the result has another shape: {got}")
        return denoised

    def _run(self, inputs: dict[str, Any]) -> Any:
        shape = inputs[self.names[0]].shape
        if shape not in self._runs:
            self._runs[shape] = compile_openvino(self.path, inputs) or partial(self.session.run, None)
        return self._runs[shape](inputs)[0]


def compile_openvino(path: Path, inputs: dict[str, Any]) -> Callable[[dict[str, Any]], Any] | None:
    """Compile a network for inputs of these shapes, by name, with as many threads as PyTorch has.

    Returns:
        What maps inputs to outputs; None if OpenVINO is not installed, or cannot compute the network.
    """
    try:
        import openvino
    except ImportError:
        return None

    core = openvino.Core()
    settings = {"INFERENCE_NUM_THREADS": torch.get_num_threads(), "INFERENCE_PRECISION_HINT": "f32"}
    try:
        model = core.read_model(path)
        model.reshape({name: list(value.shape) for name, value in inputs.items()})
        run: Callable[[dict[str, Any]], Any] = core.compile_model(model, "CPU", settings)
    except RuntimeError:
        return None
    return run


def open_session(path: Path) -> Any:
    """Open a network in ONNX Runtime, on the CPU, with as many threads as PyTorch has.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no network.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with extra("export"):
        import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # its errors are raised, not written to the terminal as well
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None


def feeds(names: Sequence[str], images: Sequence[Tensor]) -> dict[str, Any]:
    """Give a session its inputs by name: as many of the ``images``, each ``(1, 4, h, w)``, as it has ``names``."""
    inputs = {}
    for name, image in zip(names, images, strict=False):
        inputs[name] = image.numpy()
    return inputs
