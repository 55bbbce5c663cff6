r"""Colour from DNG-style metadata, and a plain development.

    srgb = encode(M diag(white_balance) demosaic(raw)),    M = (diag(X S 1)^-1 X S)^-1

with X from XYZ to the camera (DNG's ColorMatrix) and S from linear sRGB to XYZ (IEC 61966-2-1): grey stays grey. The
white balance is the inverse of DNG's AsShotNeutral. There is no tone curve but sRGB's, as in SIDD's pictures
(A. Abdelhamed, S. Lin, M. S. Brown, CVPR 2018).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.malvar import demosaic_malvar
from rawaug.io import encode_srgb

_XYZ_FROM_SRGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def color_matrix(xyz_to_camera: np.ndarray) -> Tensor:
    """M from the nine numbers of X: white-balanced camera colour to linear sRGB, float32 ``(3, 3)``, row sums 1.

    Raises:
        ValueError: if X has no such M.
    """
    camera = np.asarray(xyz_to_camera, np.float64).reshape(3, 3) @ _XYZ_FROM_SRGB
    if not (np.isfinite(camera).all() and camera.sum(axis=1).all()):
        raise ValueError(f"{np.ravel(xyz_to_camera).tolist()} is not a valid XYZ-to-camera matrix")
    return torch.from_numpy(np.linalg.inv(camera / camera.sum(axis=1, keepdims=True))).float()


def white_balance(as_shot_neutral: np.ndarray) -> tuple[float, float, float]:
    """Multipliers of R, G, B, green being 1.

    Raises:
        ValueError: if the neutral is not three positive numbers.
    """
    red, green, blue = (float(value) for value in np.ravel(as_shot_neutral))
    if not (min(red, green, blue) > 0 and max(red, green, blue) < np.inf):
        raise ValueError(f"AsShotNeutral {red:g}, {green:g}, {blue:g} is not positive")
    return green / red, 1.0, green / blue


def develop_mosaic(raw: Tensor, cfa: CFA, gains: tuple[float, float, float], matrix: Tensor) -> Tensor:
    """A mosaic ``(1, H, W)`` as a picture, uint8 ``(3, H, W)``."""
    balanced = (demosaic_malvar(raw, cfa) * torch.tensor(gains).reshape(3, 1, 1)).clamp_(0, 1)
    linear = torch.einsum("ij,jhw->ihw", matrix, balanced).clamp_(0, 1)
    return (encode_srgb(linear) * 255).round_().to(torch.uint8)
