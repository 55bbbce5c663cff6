r"""Photographs as scenes in a light, which stand in front of a simulated camera.

A photograph was balanced for the white of sRGB. In a light of colour temperature T the same things have, in CIE XYZ,

.. math:: \mathrm{XYZ} = B^{-1} \, \mathrm{diag}\!\left(\frac{B L_T}{B L_{D65}}\right) B \, S \, L(x)

with L(x) the linear values of the photograph (IEC 61966-2-1), S from linear sRGB to XYZ, :math:`L_T` the white point
of the light, and B Bradford's cone responses (CIECAM97s). A camera whose matrix from XYZ is M records M XYZ.

White points are those of a black body: B. Kang et al., "Design of advanced color temperature control system for HDTV
applications", J. Korean Physical Society 41, 2002, 1,667 to 25,000 K.

Each split has its own photographs. A folder with subfolders ``train`` and ``test`` gives training the first one, and
validation and test every other picture of the second. In any other folder, three of every five pictures are for
training, one is for validation and one for test.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.data.demo import PHOTOGRAPHS, PICTURES_ONLY, demo_files
from rawaug.data.folders import PICTURE_EXTENSIONS
from rawaug.data.pairs import require_split
from rawaug.files import files_in
from rawaug.io import decode_srgb, read_picture
from rawaug.io.pictures import MAX_PIXELS
from rawaug.io.raw import XYZ_FROM_SRGB

_SPLITS = ("train", "validation", "test")
_SHARES = ("train", "train", "train", "validation", "test")
"""The splits of five pictures of a folder, in turn."""
_LENS_BLUR = 0.6
"""Standard deviation of the point spread, in pixels."""

_BRADFORD = torch.tensor(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]],
    dtype=torch.float64,
    device="cpu",
)
_SRGB_TO_XYZ = torch.from_numpy(XYZ_FROM_SRGB).double()


def scene_files(path: str | Path, split: str) -> list[Path]:
    """List the photographs of a split: those of a folder, or the package's own if ``path`` is empty.

    Args:
        path: a folder of pictures; an empty string stands for the photographs of scikit-image's wheel.
        split: ``"train"``, ``"validation"`` or ``"test"``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is no such split, or it has no picture in this folder.
    """
    require_split(f"scenes of {path or 'the package'}", split, _SPLITS)
    if not str(path):
        return _package_files(split)
    folder = Path(path)
    files = []
    if (folder / "train").is_dir() and (folder / "test").is_dir():
        files = _subfolder_files(folder, split)
    else:
        for number, file in enumerate(files_in(folder, "picture", PICTURE_EXTENSIONS)):
            if _SHARES[number % len(_SHARES)] == split:
                files.append(file)

    if not files:
        raise ValueError(f"{path}: has no picture for {split}; give a folder with five pictures or more")
    return files


def _package_files(split: str) -> list[Path]:
    names = set(PHOTOGRAPHS[split])
    if split == "train":
        names |= set(PICTURES_ONLY)
    return [file for file in demo_files() if file.name in names]


def _subfolder_files(folder: Path, split: str) -> list[Path]:
    if split == "train":
        return files_in(folder / "train", "picture", PICTURE_EXTENSIONS)
    held_out = files_in(folder / "test", "picture", PICTURE_EXTENSIONS)
    first = 0 if split == "validation" else 1
    return held_out[first::2]


def draw_window(file: Path, size: tuple[int, int], generator: torch.Generator, max_pixels: int = MAX_PIXELS) -> Tensor:
    """Read a photograph and draw a window of it, as a lens shows it.

    The window spans at most the photograph's shorter side, and is scaled down by averaging. A photograph is enlarged
    only if it is smaller than the window.

    Args:
        file: the photograph.
        size: height and width of the window in pixels.
        generator: draws scale, place and whether it is mirrored.
        max_pixels: a larger photograph is refused.

    Returns:
        Linear sRGB in [0, 1], float32 ``(3, height, width)``.
    """
    from kornia.filters import gaussian_blur2d

    linear = decode_srgb(read_picture(file, max_pixels).float() / 255.0)
    zoom, down, right, mirror = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    height, width = linear.shape[-2:]
    largest = min(height / size[0], width / size[1])
    scale = largest
    if largest > 1.0:
        scale = max(largest**zoom, 1.0)

    window_height = min(height, max(1, round(size[0] * scale)))
    window_width = min(width, max(1, round(size[1] * scale)))
    y = int(down * (height - window_height + 1))
    x = int(right * (width - window_width + 1))
    window = linear[None, :, y : y + window_height, x : x + window_width]
    if tuple(window.shape[-2:]) != size:
        window = F.interpolate(window, size, mode="bilinear", antialias=True, align_corners=False)
    window = gaussian_blur2d(window, 5, (_LENS_BLUR, _LENS_BLUR))
    if mirror < 0.5:
        window = window.flip(-1)
    return window[0].clamp(0.0, 1.0)


def white_point(kelvin: float) -> Tensor:
    """Compute the white point of a black body at 1,667 to 25,000 K: XYZ ``(3,)`` with Y = 1, float64."""
    if not 1667.0 <= kelvin <= 25000.0:
        raise ValueError(f"a light must be 1,667 to 25,000 K, got {kelvin:g}")
    t = 1000.0 / kelvin
    if kelvin <= 4000.0:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390

    if kelvin <= 2222.0:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin <= 4000.0:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    return torch.tensor([x / y, 1.0, (1.0 - x - y) / y], dtype=torch.float64)


def camera_in_light(xyz_to_camera: Sequence[Sequence[float]], kelvin: float) -> Tensor:
    """Compute the matrix from a photograph's linear sRGB to camera RGB when its scene is lit at ``kelvin``.

    Args:
        xyz_to_camera: three rows of three numbers.
        kelvin: colour temperature of the light, 1,667 to 25,000 K.

    Returns:
        float64 ``(3, 3)``; its row sums are the camera's response to a white surface.

    Example:
        >>> identity = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> camera_in_light(identity, 3200).sum(dim=1)  # the white point of the light
        tensor([1.0604, 1.0000, 0.4454], dtype=torch.float64)
    """
    neutral = _SRGB_TO_XYZ.sum(dim=1)
    cones = (_BRADFORD @ white_point(kelvin)) / (_BRADFORD @ neutral)
    adaptation = torch.linalg.inv(_BRADFORD) @ torch.diag(cones) @ _BRADFORD
    camera = torch.tensor(xyz_to_camera, dtype=torch.float64)
    return camera @ adaptation @ _SRGB_TO_XYZ
