"""What :mod:`rawaug.evaluation.benchmark` compares: anything that makes clean RAW of noisy RAW, by one string.

A shipped denoiser or a classical filter by its name; a ``.safetensors`` of rawaug, of PMRID's authors or of BF-DnCNN;
an ``.onnx``; or ``package.module:function``, a function of noisy packed RAW ``(1, 4, h, w)``, R, Gr, Gb, B, white at 1,
and of its noise variance, or of noisy RAW alone.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

import denoisers
from denoisers.classical import Stabilised
from denoisers.domains import levels_of
from denoisers.files import find, shipped
from rawaug.bayer import CFA
from rawaug.data.pairs import Sample
from rawaug.errors import extra
from rawaug.evaluation.scores import denoise, require_classical
from rawaug.files import parse_object, read_header, read_tensors
from rawaug.noise import anscombe
from rawaug.registry import DENOISERS, FILTERS, nearest

_AGAIN = "download or convert it again"
_STRIDE = 32
"""Of a network in an ONNX file that states none."""


class Contestant(NamedTuple):
    """A denoiser: its name in tables, and ``run(noisy, variance, cfa) -> clean``, packed RAW ``(1, 4, h, w)``."""

    name: str
    run: Callable[[Tensor, Tensor, CFA], Tensor]


def shipped_of_mosaics() -> list[str]:
    """The shipped networks that denoise the mosaic and leave demosaicing to others."""
    return [name for name in shipped() if DENOISERS[read_header(find(name))["model"]].upscale == 1]


def contestant(spec: str, device: torch.device | str = "cpu") -> Contestant:
    """The denoiser that a string names; see the module."""
    path = Path(spec)
    if path.suffix == ".onnx":
        network = OnnxNetwork(path)
        return Contestant(path.stem, lambda noisy, variance, _: network(noisy, variance))
    if path.suffix == ".safetensors" and path.is_file():
        return _of_weights(path, torch.device(device))
    if ":" in spec:
        return Contestant(spec, _of_function(spec))
    if spec in shipped() or path.suffix:
        return _of_network(spec, *denoisers.load(find(spec)), torch.device(device))
    if spec in FILTERS:
        return Contestant(spec, _of_filter(spec))
    known = [*shipped(), *FILTERS]
    raise ValueError(
        f"{spec}: no such denoiser{nearest(spec, known)}; give one of {', '.join(known)}, a .safetensors, an .onnx, or "
        "package.module:function"
    )


def published_pmrid(path: str | Path) -> denoisers.PMRID:
    """PMRID with the weights of its authors."""
    model = denoisers.PMRID()
    try:
        model.load_state_dict(read_tensors(path, _AGAIN)[1])
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit PMRID's network: {str(error).splitlines()[-1].strip()}") from None
    return model.eval()


def bf_dncnn(weights: Mapping[str, Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    r"""Bias-free DnCNN for white noise, on each plane of RAW in Anscombe's domain: ``run(noisy, variance)``.

    .. math:: u = (z - z(0)) / (z(1) - z(0)), \qquad u' = u - f(u), \qquad y' = z^{-1}(u' (z(1) - z(0)) + z(0))

    with twenty 3 x 3 convolutions f without biases, normalisations folded in, and the exact unbiased inverse. Source:
    S. Mohan, Z. Kadkhodaie, E. P. Simoncelli, C. Fernandez-Granda, "Robust and interpretable blind image denoising via
    bias-free convolutional neural networks", ICLR 2020.
    """
    *layers, last = (weights[name] for name in sorted(weights))

    def grey(u: Tensor) -> Tensor:
        features = u
        for layer in layers:
            features = F.conv2d(features, layer, padding=1).relu_()
        return u - F.conv2d(features, last, padding=1)

    def run(noisy: Tensor, variance: Tensor) -> Tensor:
        shot, read = (level.flatten() for level in levels_of(noisy, variance))
        black, white = (anscombe.forward(noisy.new_full((1, 1, 1, 1), y), shot, read) for y in (0.0, 1.0))
        u = (anscombe.forward(noisy, shot, read) - black) / (white - black)
        planes = grey(u.flatten(0, 1)[:, None]).reshape(noisy.shape)
        return anscombe.inverse(planes * (white - black) + black, shot, read)

    return run


def _of_weights(path: Path, device: torch.device) -> Contestant:
    """Of rawaug, PMRID's authors or BF-DnCNN: the tensors say which."""
    metadata, tensors = read_tensors(path, _AGAIN)
    if metadata.get("format") == "rawaug":
        arm = path.resolve().parent.name  # rawaug run writes ARM/denoiser.safetensors
        return _of_network(arm if path.stem == "denoiser" else path.stem, *denoisers.load(path), device)
    if "conv00" in tensors:
        run = bf_dncnn({name: tensor.to(device) for name, tensor in tensors.items()})
        return Contestant("BF-DnCNN", lambda noisy, variance, _: run(noisy.to(device), variance.to(device)).cpu())
    if "conv0.conv.weight" in tensors:
        return _of_network("PMRID, published weights", published_pmrid(path), {}, device)
    raise ValueError(f"{path}: weights of no known denoiser; give its function as package.module:function")


def _of_network(name: str, model: denoisers.Denoiser, info: Mapping[str, Any], device: torch.device) -> Contestant:
    require_mosaic(name, model)
    model, own = model.to(device), CFA(info.get("cfa", "RGGB"))
    return Contestant(name, lambda noisy, variance, cfa: denoise(model, Sample(noisy, noisy, variance), cfa, own=own))


def require_mosaic(name: object, model: denoisers.Denoiser) -> None:
    """Refuse a network that gives full colour."""
    if model.upscale > 1:
        raise ValueError(f"{name}: demosaics, too; rawaug run demosaic --denoiser.start {name} scores it")


def _of_filter(name: str) -> Callable[[Tensor, Tensor, CFA], Tensor]:
    require_classical([name])
    stabilised = Stabilised(FILTERS.make(name), anscombe)
    return lambda noisy, variance, _: stabilised(noisy, variance)


class OnnxNetwork(nn.Module):
    """A network in an ONNX file, run by ONNX Runtime on the CPU, one picture after the other.

    ``rawaug export`` writes such a file, which states the CFA and the stride; any will do that takes noisy packed RAW
    ``(1, 4, h, w)``, and its variance or not.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.session = session_of(path)
        self.names = [value.name for value in self.session.get_inputs()]
        if not 1 <= len(self.names) <= 2:
            names = ", ".join(self.names)
            raise ValueError(f"{path}: takes {names}; a denoiser takes noisy RAW, or noisy RAW and its variance")
        self.reads_variance = len(self.names) == 2
        self.stated = dict(self.session.get_modelmeta().custom_metadata_map)
        stride = self.stated.get("stride", "")
        self.stride = (int(stride) if stride.isdecimal() else 0) or _STRIDE
        self.upscale = 2 if self.stated.get("upscale") == "2" else 1
        self.mixed = False

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """``(B, 4, h, w)`` denoised, on the CPU."""
        images = (noisy,) if variance is None else (noisy, variance)
        ones = zip(*(image.split(1) for image in images), strict=True)
        return torch.cat([torch.from_numpy(self.session.run(None, feeds(self.names, one))[0]) for one in ones])


def session_of(path: Path) -> Any:
    """ONNX Runtime on the CPU, on as many threads as PyTorch has."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with extra("export"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has a class of its own for each reason
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None


def feeds(names: Sequence[str], images: Sequence[Tensor]) -> dict[str, Any]:
    """What a session is run with; of the images those that it takes."""
    return {name: image.numpy() for name, image in zip(names, images, strict=False)}


def load_network(path: Path) -> tuple[Any, dict[str, Any]]:
    """A network and what its file says of it: a ``.safetensors`` of rawaug, or an ``.onnx``."""
    if path.suffix != ".onnx":
        return denoisers.load(path)
    network = OnnxNetwork(path)
    return network, parse_object(network.stated.get("info", "{}"))


def _of_function(spec: str) -> Callable[[Tensor, Tensor, CFA], Tensor]:
    module, _, name = spec.partition(":")
    sys.path.insert(0, str(Path.cwd()))  # as python -m does
    try:
        function = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{spec}: cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)
    parameters = inspect.signature(function).parameters.values()
    placed = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    reads_variance = sum(one.default is one.empty for one in placed) > 1

    def run(noisy: Tensor, variance: Tensor, _: CFA) -> Tensor:
        return torch.as_tensor(function(noisy, variance) if reads_variance else function(noisy)).to(noisy)

    return run
