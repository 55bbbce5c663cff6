"""Cameras as the atoms of an ISP: published ones by name, and those of data sheets, with an atom for each light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.camera.lights import D65, compute_mired, weights_in_light, white_point
from rawaug.camera.matrices import gains_in_light, load_cameras
from rawaug.camera.names import find_camera
from rawaug.camera.own import Camera, as_camera, is_camera_file
from rawaug.isp.config import ISPInfo
from rawaug.isp.dictionary import CameraDictionary, log_light
from rawaug.isp.stages import interpolate_shares
from rawaug.registry import suggest


def read_cameras(
    cameras: str | Path | Camera | Sequence[str | Path | Camera],
) -> tuple[list[Camera], list[str]]:
    """Find cameras by their names, or read their data sheets.

    Args:
        cameras: names of published cameras, cameras of one's own, or paths of their YAML files.

    Returns:
        The sheets of all cameras if one has a sheet, else none; and the published names of those without.

    Raises:
        FileNotFoundError: if a camera's file is missing.
        ValueError: if a name is unknown, or the cameras have several patterns.
    """
    if isinstance(cameras, (str, Path, Camera)):
        cameras = [cameras]

    sheets: list[Camera] = []
    published: list[str] = []
    for camera in cameras:
        if isinstance(camera, Camera) or is_camera_file(camera):
            sheets.append(as_camera(camera))
        else:
            published.append(find_camera(str(camera), load_cameras().names))

    if sheets:  # the table of published cameras has no patterns
        cfa = sheets[0].cfa
        sheets += [replace(Camera.published(name), cfa=cfa) for name in published]
        patterns = sorted({sheet.cfa for sheet in sheets})
        if len(patterns) > 1:
            raise ValueError(f"cameras have several patterns, {', '.join(patterns)}; give those of one pattern")
    return sheets, published


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


def data_sheet_info(cameras: Sequence[Camera]) -> ISPInfo:
    """What an ISP records of the cameras that it was made of; the noise is that of a single one."""
    info: ISPInfo = {
        "cameras": [camera.name for camera in cameras],
        "own_cameras": [camera.to_json() for camera in cameras],
    }
    if cameras[0].cfa not in CFA.__members__:
        info["pattern"] = cameras[0].cfa
    noise = cameras[0].noise_spec()
    if len(cameras) == 1 and noise is not None:
        info["noise"] = noise
    return info
