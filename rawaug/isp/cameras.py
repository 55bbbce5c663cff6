"""Cameras as the atoms of an ISP: published ones by name, and those of data sheets, with an atom for each light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rawaug.camera.lights import D65, compute_mired, weights_in_light, white_point
from rawaug.camera.matrices import gains_in_light, load_cameras
from rawaug.camera.own import Camera
from rawaug.isp.dictionary import CameraDictionary, log_light
from rawaug.isp.stages import interpolate_shares
from rawaug.registry import suggest


def published_atoms(names: Sequence[str]) -> CameraDictionary:
    """Make an atom of each published camera; ValueError if one is not listed."""
    return CameraDictionary.from_xyz(load_cameras().select(names), torch.eye(len(names)))


def data_sheet_atoms(cameras: Sequence[Camera]) -> CameraDictionary:
    """Make an atom of each light of each camera; in daylight a camera is the mixture of those beside it."""
    daylight = white_point(D65)
    mired = compute_mired(daylight[None].numpy())

    matrices, lights, mixtures = [], [], []
    for camera in cameras:
        anchors = camera.anchors()
        by_day = weights_in_light([anchor.mired for anchor in anchors], mired)
        mixtures.append(torch.from_numpy(by_day).float())
        for anchor in anchors:
            matrices.append(anchor.matrix)
            lights.append(log_light(gains_in_light(anchor.from_xyz, daylight)[None])[0])

    return CameraDictionary.from_atoms(torch.stack(matrices), torch.stack(lights), torch.block_diag(*mixtures))


def data_sheet_shading(cameras: Sequence[Camera]) -> Tensor | None:
    """The shares of light ``(N, 3, 33, 33)`` that arrive over the frame, by atom; None if no camera states them."""
    if all(camera.shading is None for camera in cameras):
        return None

    tables = []
    for camera in cameras:
        for anchor in camera.anchors():
            shares = camera.shading_in(anchor.light)
            if shares is None:
                shares = torch.ones(3, 2, 2)
            tables.append(interpolate_shares(shares))
    return torch.stack(tables)


def data_sheet_tones(cameras: Sequence[Camera], curves: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse curves ``(1021,)`` by name to draw cameras with: their own, or all of an ISP's if one has none.

    Args:
        cameras: the cameras.
        curves: the curves of the ISP by name.

    Raises:
        ValueError: if a camera names a curve that the ISP does not have.
    """
    nodes = len(next(iter(curves.values())))
    tones: dict[str, Tensor] = {}
    for camera in cameras:
        points = camera.inverse_curve(nodes)
        if camera.tone is None:
            tones |= curves
        elif points is not None:
            tones[camera.name] = points
        elif camera.tone in curves:
            tones[camera.tone] = curves[camera.tone]
        else:
            names = list(curves)
            unknown = f"camera {camera.name!r}: tone {camera.tone!r:.80} is unknown"
            raise ValueError(f"{unknown}; use points or one of {', '.join(names)}{suggest(camera.tone, names)}")
    return tones
