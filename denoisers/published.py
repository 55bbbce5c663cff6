"""Files of weights of any kind: rawaug's own, and published ones of PMRID, PBRID, BF-DnCNN and FFDNet.

Published weights are told apart by their tensors. The file says which kind of image its network takes, packed RAW or
developed pictures, and the pattern that it was trained for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers import anscombe
from denoisers.domains import fit_levels
from denoisers.ffdnet import FFDNet
from denoisers.files import restore
from denoisers.network import PACKED
from denoisers.pbrid import PBRID
from denoisers.pmrid import PMRID
from rawaug.bayer import CFA
from rawaug.files import parse_object, read_tensors

Image = Literal["raw", "srgb"]
"""The kind of image that a network takes: packed RAW, or developed pictures."""
AGAIN = "download or convert it again"
"""The advice about a damaged file of weights."""

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


@dataclass(frozen=True)
class Published:
    """A network with its authors' weights.

    Attributes:
        name: in tables.
        tensor: the name of a tensor that no other network's file has.
        build: makes the network from the path of its file and the tensors in it.
        image: the kind of image that it takes.
        cfa: the pattern that it was trained for; None if it works on any of Bayer's.
    """

    name: str
    tensor: str
    build: Callable[[Path, Mapping[str, Tensor]], nn.Module]
    image: Image = "raw"
    cfa: CFA | None = CFA.RGGB


def _bias_free(path: Path, tensors: Mapping[str, Tensor]) -> nn.Module:
    return BiasFreeDnCNN(tensors)


def _with_weights(network: type[nn.Module], path: Path, tensors: Mapping[str, Tensor]) -> nn.Module:
    return load_published(network(), path)


PUBLISHED = (
    Published("BF-DnCNN", "conv00", _bias_free, cfa=None),
    Published("PMRID, published weights", "conv0.conv.weight", partial(_with_weights, PMRID)),
    Published("PBRID, published weights", "rec_blocks.m_head.weight", partial(_with_weights, PBRID)),
    Published("FFDNet, published weights", "conv00.weight", partial(_with_weights, FFDNet), image="srgb"),
)
"""The published weights that can be read."""


class NetworkFile(NamedTuple):
    """A network that was read from a file.

    Attributes:
        path: the file.
        name: its name in tables: that of the file, or of the arm whose weights it has.
        network: the network, in eval mode, on the CPU.
        info: what the file says of its training.
        image: the kind of image that it takes.
        cfa: the pattern that it was trained for; None if it works on any of Bayer's.
    """

    path: Path
    name: str
    network: nn.Module
    info: Mapping[str, Any]
    image: Image
    cfa: CFA | None


def read_network(path: Path) -> NetworkFile:
    """Read the network of a ``.safetensors`` file of any kind.

    Raises:
        ValueError: if the file is damaged, or holds weights of no known denoiser.
    """
    metadata, tensors = read_tensors(path, AGAIN)
    if metadata.get("format") == "rawaug":
        network, info = restore(path, metadata, tensors)
        name = path.stem
        if name == "denoiser":  # rawaug run writes ARM/denoiser.safetensors
            name = path.resolve().parent.name
        return NetworkFile(path, name, network, info, _image_kind(network.channels), CFA(info.get("cfa", "RGGB")))

    for published in PUBLISHED:
        if published.tensor in tensors:
            built = published.build(path, tensors).eval()
            return NetworkFile(path, published.name, built, {}, published.image, published.cfa)

    raise ValueError(f"{path}: weights of no known denoiser; give a network or a function from Python")


def find_image_kind(header: Mapping[str, str]) -> Image:
    """Find the kind of image that the network of a rawaug file takes, by the file's metadata."""
    return _image_kind(parse_object(header["config"]).get("channels", PACKED))


def _image_kind(channels: int) -> Image:
    return "srgb" if channels == 3 else "raw"
