"""Networks in ONNX files, run by ONNX Runtime on the CPU.

``rawaug export`` writes such a file, which states the CFA and the stride; any will do that takes noisy packed RAW
``(1, 4, h, w)``, and its variance or not. What anybody's file does wrong is one line that names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rawaug.errors import extra
from rawaug.files import parse_object

STRIDE = 32
"""Of a network that states none."""


class OnnxNetwork(nn.Module):
    """A network in an ONNX file, which takes one picture after the other.

    Raises:
        FileNotFoundError, ValueError: if there is no such file, ONNX Runtime refuses it, or it takes other inputs.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.session = path, session_of(path)
        self.names = [value.name for value in self.session.get_inputs()]
        if not 1 <= len(self.names) <= 2:
            names = ", ".join(self.names)
            raise ValueError(f"{path}: takes {names}; a denoiser takes noisy RAW, or noisy RAW and its variance")
        self.reads_variance = len(self.names) == 2
        stated = dict(self.session.get_modelmeta().custom_metadata_map)
        self.info: dict[str, Any] = parse_object(stated.get("info", "{}"))
        stride = stated.get("stride", "")
        self.stride = (int(stride) if stride.isdecimal() else 0) or STRIDE
        self.upscale = 2 if stated.get("upscale") == "2" else 1

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """``(B, 4, h, w)`` denoised, on the CPU; ValueError with ONNX Runtime's reason where it fails."""
        images = (noisy,) if variance is None else (noisy, variance)
        ones = zip(*(image.split(1) for image in images), strict=True)
        try:
            found = [self.session.run(None, feeds(self.names, one))[0] for one in ones]
        except Exception as error:  # ONNX Runtime has a class of its own for each reason
            raise ValueError(f"{self.path}: {' '.join(str(error).split())}") from None
        return torch.cat([torch.as_tensor(one) for one in found])


def session_of(path: Path) -> Any:
    """ONNX Runtime on the CPU, on as many threads as PyTorch has."""
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
    """The inputs of a session by name, of ``images`` as many as it takes."""
    return {name: image.numpy() for name, image in zip(names, images, strict=False)}
