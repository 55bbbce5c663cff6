r"""What denoises a RAW frame: a network, or a classical filter where there is none.

A network takes packed RAW and its noise map ``shot_var max(y, 0) + read_var``, a filter the same RAW with its noise
made white (:class:`denoisers.Stabilised`). Both work in tiles, on the mosaic as the sensor gave it.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

import denoisers
from denoisers.network import Denoiser
from denoisers.pretrained import DEFAULT, find
from denoisers.stabilised import Stabilised
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.sample import Sample
from rawaug.devices import find_device
from rawaug.evaluation.scores import counted, denoise, require_classical
from rawaug.files import sha256
from rawaug.noise import anscombe
from rawaug.registry import FILTERS, Spec

FILTER_TILE, FILTER_OVERLAP = 512, 32
"""Packed pixels; the filters look 8 pixels around, and BM3D 20."""


class Frame(Protocol):
    """What is denoised: a RAW file's frame, or a block of one."""

    @property
    def mosaic(self) -> Tensor:
        """float32 ``(1, H, W)``."""

    @property
    def cfa(self) -> CFA:
        """Its pattern."""


class FrameDenoiser(Protocol):
    """Denoises the mosaic of a frame, given its noise levels."""

    @property
    def reads_levels(self) -> bool:
        """Whether the levels are used."""

    @property
    def settings(self) -> dict[str, Any]:
        """What the result depends on besides the frame and its levels, as JSON."""

    def __call__(self, frame: Frame, levels: tuple[float, float]) -> Tensor:
        """float32 ``(1, H, W)`` on the CPU, at most 1, not clipped at black."""


class NetworkDenoiser:
    """A trained network.

    Args:
        weights: its file, or the name of a shipped one.
        self_ensemble: average eight views.
        device: see :func:`rawaug.devices.find_device`.

    Raises:
        FileNotFoundError, ValueError: if there is no such denoiser or device.
    """

    def __init__(self, weights: str | Path, self_ensemble: bool = False, device: str = "auto") -> None:
        where, path = find_device(device), find(weights)
        model, info = denoisers.load(path)
        self.model = model.to(where, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.cfa, self.self_ensemble = CFA(info.get("cfa", "RGGB")), self_ensemble
        self.settings: dict[str, Any] = {"denoiser_sha256": sha256(path), "self_ensemble": self_ensemble}

    @property
    def reads_levels(self) -> bool:
        """Whether the network has a noise map or a variance-stabilising transform."""
        return self.model.reads_variance

    def __call__(self, frame: Frame, levels: tuple[float, float]) -> Tensor:
        """See :class:`FrameDenoiser`."""
        return denoise_mosaic(self.model, self.cfa, frame, levels, self.self_ensemble)


def denoise_mosaic(
    model: Denoiser, cfa: CFA, frame: Frame, levels: tuple[float, float], self_ensemble: bool = False
) -> Tensor:
    """The frame's mosaic denoised, float32 ``(1, H, W)`` on the CPU, at most 1, not clipped at black.

    Args:
        model: a network for packed RAW, on any device.
        cfa: the pattern of the mosaics that it was trained on.
        frame: what to denoise.
        levels: (shot_var, read_var).
        self_ensemble: average eight views.
    """
    height, width = frame.mosaic.shape[-2:]
    rows, columns = frame.cfa.shift_to(cfa)
    packed = bayer.pack(F.pad(frame.mosaic[None], (columns, columns, rows, rows), mode="reflect"), cfa)
    shot_var, read_var = levels
    variance = packed.clamp(min=0).mul_(shot_var).add_(read_var)
    denoised = denoise(model, Sample(packed, packed, variance), cfa, 8 if self_ensemble else 1)
    mosaic = bayer.unpack(denoised, cfa)[0]
    return mosaic[..., rows : rows + height, columns : columns + width].clamp(max=1.0)


class ClassicalDenoiser:
    """A classical filter, which needs no training.

    Args:
        spec: a name of :data:`rawaug.registry.FILTERS`, or ``{name, settings}``.

    Raises:
        ValueError: if there is no such filter, or its library is not installed.
    """

    reads_levels = True

    def __init__(self, spec: Spec) -> None:
        require_classical([spec])
        self.filter = FILTERS.make(spec)
        self.settings: dict[str, Any] = {"classical": spec}

    def __call__(self, frame: Frame, levels: tuple[float, float]) -> Tensor:
        """See :class:`FrameDenoiser`."""
        packed = bayer.pack(frame.mosaic[None], frame.cfa)
        run = partial(self._tile, levels=levels)
        denoised = denoisers.tiled(run, packed, None, FILTER_TILE, FILTER_OVERLAP, counted("tile"))
        return bayer.unpack(denoised, frame.cfa)[0].clamp(max=1.0)

    def _tile(self, noisy: Tensor, _: Tensor | None, levels: tuple[float, float]) -> Tensor:
        if levels[0] == 0:  # no shot noise: white already
            denoised: Tensor = self.filter(noisy, torch.tensor(levels[1]))
            return denoised
        shot_var, read_var = (torch.tensor([level]) for level in levels)
        return Stabilised(self.filter, anscombe)(noisy, shot_var=shot_var, read_var=read_var)


def frame_denoiser(
    denoiser: str | Path | None = None, classical: Spec | None = None, self_ensemble: bool = False, device: str = "auto"
) -> FrameDenoiser:
    """What denoises: the network, the classical filter, or the network that is taken where neither is named.

    Raises:
        FileNotFoundError, ValueError: if there is none such, or both are named.
    """
    if classical is None:
        return NetworkDenoiser(DEFAULT if denoiser is None else denoiser, self_ensemble, device)
    if denoiser is not None or self_ensemble:
        raise ValueError("classical: a filter takes neither --denoiser nor --self-ensemble; give one or the other")
    return ClassicalDenoiser(classical)
