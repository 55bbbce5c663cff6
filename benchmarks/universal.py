r"""The universal ISP, from published figures alone: ``python -m benchmarks.universal --out universal.safetensors``.

Colour atoms are chosen greedily among the published cameras, so that their hull holds as many of all of them as it can
on the colours of the package's photographs. Two matrices C and C' differ on pictures of second moment
:math:`S = E[x x^T]`, x in linear sRGB, by

.. math:: \mathrm{MSE} = \tfrac{1}{3} \| (C - C') S^{1/2} \|_F^2 ,

a squared distance in the coordinates :math:`C S^{1/2} / \sqrt 3`. Tone atoms are the published curves, or as many of
them as are asked for, chosen likewise on the grey levels of a picture. These are monotone cubics (Fritsch and Carlson,
1980) through the points of darktable's base curves, measured against cameras' JPEGs or drawn after a maker's; besides
them ``linear``, LibRaw's rendering, which has no curve, and ``upi``, the smoothstep and gamma 2.2 of Brooks et al.
(CVPR 2019). Gain atoms, which only a guess of a picture's setting needs, hold the gains of all cameras in all lights;
when augmenting, gains follow from camera and light.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.spatial import ConvexHull
from torch import Tensor

from rawaug.camera.lights import sample_lights
from rawaug.camera.matrices import camera_from_srgb, gains_in_light, load_cameras
from rawaug.camera.samplers import PLAUSIBLE_GAINS
from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import CameraDictionary, GainDictionary, nearest_in_hull
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import NODES, STEPS, ToneDictionary, srgb_to_linear
from rawaug.paper.baselines.upi import inverse_smoothstep
from rawaug.seeding import keyed_generator

CURVES = Path(__file__).with_name("tone_curves.json")
COLOURS = ((0.1469, 0.0839, 0.0661), (0.0839, 0.0620, 0.0536), (0.0661, 0.0536, 0.0503))
"""Second moment of linear sRGB: mean of the six photographs of :mod:`rawaug.data.demo`, every fourth row and column."""
LIGHTS = 4000
"""Draws of camera and light that the gain atoms are chosen for: of 400, the corners of the hull are too few."""
DECIBEL = 45.0
"""A point this near to a hull is held by it."""
CANDIDATES = 24
"""Points farthest from the hull so far that are tried as its next atom."""
TONE_AND_CAMERAS = ("curve", "colour", "gains")


class Choice(NamedTuple):
    """Atoms among points by index, and the weights whose mixture is nearest the points' mean."""

    atoms: list[int]
    typical: Tensor


def universal_isp(colour_atoms: int = 10, tone_atoms: int | None = None, gain_atoms: int = 16) -> DictionaryISP:
    """Build the ISP; ``info`` names its atoms and what their hulls hold of all points, within 45 dB."""
    cameras, names, tables = load_cameras(), list(tone_tables()), torch.stack(list(tone_tables().values()))
    distinct = distinct_cameras()
    points = camera_points(distinct)
    colour = chosen_atoms(points, colour_atoms)
    tone = chosen_atoms(tone_points(tables), len(names) if tone_atoms is None else tone_atoms)
    inverse = inverse_gains_in_any_light(distinct)
    gain = chosen_gains(inverse, gain_atoms)
    with torch.no_grad():
        red, green, blue = (1.0 / inverse[gain.atoms]).unbind(1)
        gains = torch.stack([green, red / green, blue / green], dim=1).float()
    # A sensor clips each channel at its own white, so there is no knee.
    isp = DictionaryISP(ISPConfig(stages=TONE_AND_CAMERAS, tone_atoms=1, knee=None)).with_atoms(
        colour=CameraDictionary.from_xyz(distinct[colour.atoms], nearest_in_hull(points, points[colour.atoms])[0]),
        gain=GainDictionary.from_gains(gains),
        tone=ToneDictionary.from_curves(tables[tone.atoms], tone.typical),
    )
    assert isinstance(isp.colour, CameraDictionary)
    for encoders in (isp.reverse_encoders, isp.forward_encoders):
        encoders.colour.set_prior(isp.colour.typical)
        encoders.gain.set_prior(gain.typical)
    isp.info |= {
        "cameras": [_name_of(distinct[index], cameras.names, cameras.xyz_to_camera) for index in colour.atoms],
        "tones": [names[index] for index in tone.atoms],
        "holds": {
            "cameras": held(camera_points(cameras.xyz_to_camera), points[colour.atoms]),
            "gains": held(inverse / 3**0.5, inverse[gain.atoms] / 3**0.5),
            "tones": held(tone_points(tables), tone_points(tables[tone.atoms])),
        },
    }
    return isp.eval()


@cache
def tone_tables() -> dict[str, Tensor]:
    """The published curves by name: tables ``(1021,)`` float32 from 0 to 1, not decreasing."""
    code = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
    display = srgb_to_linear(code)
    tables = {"linear": display.float(), "upi": inverse_smoothstep(code).clamp_min(0.0).pow(2.2).float()}
    for name, points in json.loads(CURVES.read_text("utf-8"))["curves"].items():
        tables[name] = _inverse(points, display).float()
    return tables


def _inverse(points: Sequence[Sequence[float]], display: Tensor) -> Tensor:
    """Camera light ``(N,)`` at which the monotone cubic through ``points`` (camera, display) reaches ``display``."""
    camera, shown = np.array(points).T
    shown[0] = 0.0  # a measured curve may start at an offset
    light = np.linspace(0.0, 1.0, 2**16) ** 2  # dense near black
    reached = np.maximum.accumulate(PchipInterpolator(camera, shown)(light))
    reached = reached / reached[-1]
    rising = np.concatenate([[True], np.diff(reached) > 0])
    return torch.from_numpy(np.interp(display.numpy(), reached[rising], light[rising]))


def distinct_cameras() -> Tensor:
    """The different matrices among the published ones ``(M, 3, 3)``: bodies that share a sensor often share theirs."""
    return torch.unique(load_cameras().xyz_to_camera, dim=0)


def camera_points(xyz_to_camera: Tensor) -> Tensor:
    """Cameras as points ``(N, 9)`` whose squared distance is the error of their colour on photographs."""
    return colour_coordinates(camera_from_srgb(xyz_to_camera), torch.tensor(COLOURS))


def colour_coordinates(matrices: Tensor, moment: Tensor) -> Tensor:
    """``(N, 3, 3)`` to points ``(N, 9)`` whose squared distance is the mean squared error on such pictures."""
    values, vectors = torch.linalg.eigh(moment.double())
    root = vectors @ torch.diag(values.clamp_min(0.0).sqrt()) @ vectors.T
    return (matrices.double() @ root / 3**0.5).flatten(1)


def tone_points(tables: Tensor) -> Tensor:
    """Curves ``(K, 1021)`` as points ``(K, 256)`` whose squared distance is the mean squared error over all codes."""
    return tables[:, ::STEPS].double() / 16.0


def inverse_gains_in_any_light(xyz_to_camera: Tensor, key: str = "universal gains", draws: int = LIGHTS) -> Tensor:
    """One over the gains, the smallest of which is 1, of random cameras in random lights ``(P, 3)``, P <= ``draws``."""
    generator = keyed_generator(key)
    camera = xyz_to_camera[torch.randint(len(xyz_to_camera), (draws,), generator=generator)]
    balance = gains_in_light(camera, torch.from_numpy(sample_lights(draws, generator)))
    low, high = PLAUSIBLE_GAINS
    balance = balance[((balance >= low) & (balance <= high)).all(dim=1)]
    return balance.amin(dim=1, keepdim=True) / balance


def chosen_atoms(points: Tensor, count: int) -> Choice:
    """``count`` atoms among ``points`` ``(P, D)``."""
    atoms = list(range(len(points))) if count >= len(points) else greedy_atoms(points, count)
    typical = nearest_in_hull(points.mean(dim=0, keepdim=True), points[atoms])[0][0]
    return Choice(atoms, typical.float())


def chosen_gains(inverse: Tensor, count: int) -> Choice:
    """``count`` atoms among the corners of the hull of inverse gains ``(P, 3)``."""
    points = inverse / 3**0.5
    corners = extreme_points(points)
    chosen = corners[chosen_atoms(points[corners], count).atoms]
    return Choice(chosen.tolist(), nearest_in_hull(points.mean(dim=0, keepdim=True), points[chosen])[0][0].float())


def psnr(squared_error: Tensor) -> Tensor:
    """PSNR in dB, data range 1."""
    return -10.0 * squared_error.clamp_min(1e-20).log10()


def greedy_atoms(points: Tensor, count: int) -> list[int]:
    """Indices of ``count`` points ``(P, D)`` whose hull reaches as many of all of them as possible."""
    # The first is the point farthest from the mean. Each next one is, among the farthest from the hull so far, the one
    # that leaves the least total squared error over the points that the hull does not hold.
    chosen = [int((points - points.mean(dim=0)).square().sum(dim=1).argmax())]
    while len(chosen) < min(count, len(points)):
        errors = nearest_in_hull(points, points[chosen])[1]
        farthest = errors.topk(min(CANDIDATES, len(points))).indices.tolist()
        candidates = [index for index in farthest if index not in chosen]
        open_ = psnr(errors) < DECIBEL
        if not open_.any():
            open_ = torch.ones_like(open_)
        hulls = points[torch.tensor([[*chosen, new] for new in candidates])]
        chosen.append(candidates[int(nearest_in_hull(points[open_], hulls)[1].sum(dim=1).argmin())])
    return chosen


def extreme_points(points: Tensor) -> Tensor:
    """Indices of the points ``(P, D)``, D small, that are corners of the hull of all: only these make it wide."""
    return torch.from_numpy(ConvexHull(points.numpy()).vertices).long().sort().values


def held(points: Tensor, atoms: Tensor) -> float:
    """Share of ``points`` within 45 dB of the hull of ``atoms``, to four digits."""
    return round((psnr(nearest_in_hull(points, atoms)[1]) >= DECIBEL).double().mean().item(), 4)


def _name_of(matrix: Tensor, names: Sequence[str], matrices: Tensor) -> str:
    """The first camera that has this matrix."""
    return names[int((matrices == matrix).flatten(1).all(dim=1).nonzero()[0])]


def main(*, out: str, atoms: int = 10, tones: int | None = None, gains: int = 16) -> None:
    """Write the ISP and print what its hulls hold.

    Args:
        out: the .safetensors file to write.
        atoms: colour atoms.
        tones: tone atoms; all curves by default.
        gains: gain atoms.
    """
    isp = universal_isp(atoms, tones, gains)
    isp.save(out)
    for what, share in isp.info["holds"].items():
        print(f"{what}: {share:.1%} within 45 dB")


if __name__ == "__main__":
    from cyclopts import run

    run(main)
