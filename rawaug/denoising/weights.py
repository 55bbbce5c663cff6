"""Files of weights: those that ``rawaug run`` writes, and published ones, which are told apart by their tensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from torch import Tensor, nn

import denoisers
from denoisers.network import PACKED
from denoisers.pbrid import PBRID
from rawaug.bayer import CFA
from rawaug.denoising.foreign import AGAIN, BiasFreeDnCNN, load_published
from rawaug.files import parse_object, read_tensors

Image = Literal["raw", "srgb"]
"""A denoiser takes this kind of image: packed RAW, or developed pictures."""


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
    Published("PMRID, published weights", "conv0.conv.weight", partial(_with_weights, denoisers.PMRID)),
    Published("PBRID, published weights", "rec_blocks.m_head.weight", partial(_with_weights, PBRID)),
    Published("FFDNet, published weights", "conv00.weight", partial(_with_weights, denoisers.FFDNet), image="srgb"),
)
"""These published weights can be read."""


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
        network, info = denoisers.load(path)
        name = path.stem
        if name == "denoiser":  # rawaug run writes ARM/denoiser.safetensors
            name = path.resolve().parent.name
        return NetworkFile(path, name, network, info, _image_of(network.channels), CFA(info.get("cfa", "RGGB")))

    for one in PUBLISHED:
        if one.tensor in tensors:
            return NetworkFile(path, one.name, one.build(path, tensors).eval(), {}, one.image, one.cfa)

    raise ValueError(f"{path}: weights of no known denoiser; give a network or a function from Python")


def image_of_header(header: Mapping[str, str]) -> Image:
    """Find the kind of image that the network of a rawaug file takes, by the file's metadata."""
    return _image_of(parse_object(header["config"]).get("channels", PACKED))


def _image_of(channels: int) -> Image:
    return "srgb" if channels == 3 else "raw"
