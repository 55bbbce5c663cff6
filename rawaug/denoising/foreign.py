"""Other people's networks: ONNX files, and published networks with their authors' weights.

``rawaug export`` writes ONNX that states the CFA and the stride. Any other ONNX file will do that takes noisy packed
RAW ``(1, 4, h, w)``, with or without its variance. If a file does something wrong, the error is one line that names it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.domains import fit_levels
from rawaug.errors import extra
from rawaug.files import parse_object, read_tensors
from rawaug.noise import anscombe

STRIDE = 32
"""This is the default stride of a network."""


class OnnxNetwork(nn.Module):
    """A network in an ONNX file, which takes one picture after the other.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if ONNX Runtime refuses it, or it takes other inputs.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.session = session_of(path)
        self.names = [value.name for value in self.session.get_inputs()]
        if not 1 <= len(self.names) <= 2:
            names = ", ".join(self.names)
            raise ValueError(f"{path}: takes {names}; a denoiser takes noisy RAW, or noisy RAW and its variance")
        self.reads_variance = len(self.names) == 2

        metadata = dict(self.session.get_modelmeta().custom_metadata_map)
        self.info: dict[str, Any] = parse_object(metadata.get("info", "{}"))
        self.stride = STRIDE
        stride = metadata.get("stride", "")
        if stride.isdecimal() and int(stride) > 0:
            self.stride = int(stride)
        self.upscale = 2 if metadata.get("upscale") == "2" else 1

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise RAW ``(B, 4, h, w)`` on the CPU; raise ValueError with ONNX Runtime's reason if it fails."""
        results = []
        try:
            for index in range(len(noisy)):
                inputs = [noisy[index : index + 1]]
                if variance is not None:
                    inputs.append(variance[index : index + 1])
                result = self.session.run(None, feeds(self.names, inputs))[0]
                results.append(torch.as_tensor(result))
        except Exception as error:  # ONNX Runtime has a class of its own for each reason
            raise ValueError(f"{self.path}: {' '.join(str(error).split())}") from None

        denoised = torch.cat(results)
        sides = [self.upscale * side for side in noisy.shape[-2:]]
        if denoised.ndim != 4 or list(denoised.shape[-2:]) != sides:
            got = f"{tuple(denoised.shape)} for {tuple(noisy.shape)}"
            raise ValueError(f"{self.path}: the result has another shape: {got}")
        return denoised


def session_of(path: Path) -> Any:
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


AGAIN = "download or convert it again"
"""This is the advice about a damaged file of weights."""

Network = TypeVar("Network", bound=nn.Module)


def load_published(model: Network, path: str | Path) -> Network:
    """Give a network the weights of its authors, from a ``.safetensors`` file, and put it in eval mode.

    Args:
        model: PMRID, PBRID, or FFDNet for colour, whose normalisations are folded into its convolutions.
        path: path of the file.

    Raises:
        ValueError: if the file is damaged or holds other weights.
    """
    _, weights = read_tensors(path, AGAIN)
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ValueError(f"{path} does not fit {type(model).__name__}'s network: {reason}") from None
    return model.eval()


class BiasFreeDnCNN(nn.Module):
    r"""Bias-free DnCNN for white noise, on each plane of RAW in Anscombe's domain.

    .. math:: u = (z - z(0)) / (z(1) - z(0)), \qquad u' = u - f(u), \qquad y' = z^{-1}(u' (z(1) - z(0)) + z(0))

    f are twenty 3 x 3 convolutions without biases, into which normalisations are folded, and the inverse is the exact
    unbiased one. Source: S. Mohan, Z. Kadkhodaie, E. P. Simoncelli, C. Fernandez-Granda, "Robust and interpretable
    blind image denoising via bias-free convolutional neural networks", ICLR 2020.

    Args:
        weights: weights of the convolutions, ``(n, m, 3, 3)``, by names in the order of the convolutions.
    """

    reads_variance = True

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.layers = nn.ParameterList([weights[name] for name in sorted(weights)])

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Denoise packed RAW ``(B, 4, h, w)``; ``variance`` is a map ``shot_var max(noisy, 0) + read_var``."""
        shot_var, read_var = fit_levels(noisy, variance)
        levels = shot_var.flatten(), read_var.flatten()
        black = anscombe.forward(noisy.new_full((1, 1, 1, 1), 0.0), *levels)
        white = anscombe.forward(noisy.new_full((1, 1, 1, 1), 1.0), *levels)

        u = (anscombe.forward(noisy, *levels) - black) / (white - black)
        planes = self._grey(u.flatten(0, 1)[:, None]).reshape(noisy.shape)
        return anscombe.inverse(planes * (white - black) + black, *levels)

    @torch.no_grad()
    def _grey(self, u: Tensor) -> Tensor:
        *layers, last = self.layers
        features = u
        for layer in layers:
            features = F.conv2d(features, layer, padding=1).relu_()
        return u - F.conv2d(features, last, padding=1)
