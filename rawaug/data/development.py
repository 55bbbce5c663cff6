r"""A plain development of RAW to sRGB, with the colours of DNG's tags.

    srgb = encode(M diag(white_balance) demosaic(raw)),    M = (diag(X S 1)^-1 X S)^-1

with X from XYZ to the camera (DNG's ColorMatrix) and S from linear sRGB to XYZ (IEC 61966-2-1), so that grey stays
grey. The white balance is the inverse of DNG's AsShotNeutral. There is no tone curve but sRGB's, as in SIDD's pictures
(A. Abdelhamed, S. Lin, M. S. Brown, CVPR 2018).

Pictures of pairs use the demosaicing of Malvar, He and Cutler. Scores and figures use bilinear interpolation, which
favours no denoiser.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame, encode_srgb
from rawaug.io.raw import XYZ_FROM_SRGB

UNKNOWN_COLOUR = (1.0, 1.0, 1.0), torch.eye(3, device="cpu")
"""The gains and the matrix of frames whose dataset states none."""


def srgb_from_camera(xyz_to_camera: np.ndarray) -> Tensor:
    """M from the nine numbers of X: white-balanced camera colour to linear sRGB, float32 ``(3, 3)``, row sums 1."""
    camera = np.asarray(xyz_to_camera, np.float64).reshape(3, 3) @ XYZ_FROM_SRGB
    if not (np.isfinite(camera).all() and camera.sum(axis=1).all()):
        raise ValueError(f"{np.ravel(xyz_to_camera).tolist()} is not a valid XYZ-to-camera matrix")

    return torch.from_numpy(np.linalg.inv(camera / camera.sum(axis=1, keepdims=True))).float()


def gains_from_neutral(as_shot_neutral: np.ndarray) -> tuple[float, float, float]:
    """The multipliers of R, G and B from the tag AsShotNeutral; that of green is 1."""
    red, green, blue = map(float, np.ravel(as_shot_neutral))
    if not (min(red, green, blue) > 0 and max(red, green, blue) < np.inf):
        raise ValueError(f"AsShotNeutral {red:g}, {green:g}, {blue:g} is not positive")
    return green / red, 1.0, green / blue


def render_raw(
    raw: Tensor,
    cfa: CFA | str,
    gains: Sequence[float],
    matrix: Tensor,
    demosaicing: str = "malvar",
    exposure: float = 1.0,
    least: float | None = 0.0,
) -> Tensor:
    """Render a mosaic ``(1, H, W)`` as a picture, sRGB ``(3, H, W)`` in [0, 1]; no tone curve but sRGB's.

    ``exposure`` is a factor on all colours. ``least`` is the value at which camera colour is clipped; None keeps the
    zero-mean noise of shadows until the conversion to sRGB.

    Example:
        >>> render_raw(torch.full((1, 8, 8), 0.5), "RGGB", (1, 1, 1), torch.eye(3)).mean().item()  # doctest: +ELLIPSIS
        0.735...
    """
    rgb = bayer.demosaic(raw[None], cfa, demosaicing)[0]
    return render_rgb(rgb, gains, matrix, exposure, least)


def render_rgb(
    rgb: Tensor, gains: Sequence[float], matrix: Tensor, exposure: float = 1.0, least: float | None = 0.0
) -> Tensor:
    """Render linear camera RGB ``(3, H, W)`` as a picture; the arguments are as in :func:`render_raw`."""
    balanced = rgb * exposure * torch.tensor(gains).reshape(3, 1, 1)
    balanced = balanced.clamp(least, 1)

    linear = torch.einsum("ij,jhw->ihw", matrix, balanced).clamp(0, 1)
    return encode_srgb(linear)


def develop_mosaic(frame: RawFrame) -> Tensor:
    """Develop the mosaic of a frame to the picture of a pair, uint8 ``(3, H, W)``."""
    picture = render_raw(frame.mosaic, frame.cfa, frame.white_balance, frame.color_matrix)
    return (picture * 255).round_().to(torch.uint8)


def develop_pair(name: str, clean: RawFrame, noisy: RawFrame | None = None, **attributes: Any) -> Pair:
    """Make a pair with further ``attributes``; without ``srgb`` its picture is a plain development of ``clean``."""
    if "srgb" not in attributes:
        attributes["srgb"] = develop_mosaic(clean)
    return Pair(name, clean, noisy=noisy, **attributes)


def develop_packed(packed: Tensor, cfa: CFA, pair: Pair, exposure: float = 1.0) -> Tensor:
    """Develop packed RAW ``(1, 4, h, w)`` to sRGB ``(3, H, W)`` in [0, 1] with the colours of ``pair``, for scores."""
    raw = bayer.unpack(packed, cfa)[0]
    return render_raw(raw, cfa, pair.clean.white_balance, pair.clean.color_matrix, "bilinear", exposure, least=None)


def exposure_gain(packed: Tensor, pair: Pair) -> float:
    """Compute the factor that brings the brightest percent of a clean frame to white."""
    green = packed[:, 1:3].flatten()
    stride = max(1, green.numel() // 1_000_000)
    brightest = torch.quantile(green[::stride], 0.99).clamp_min(1e-3)

    least_gain = max(1.0, min(pair.clean.white_balance))
    return float(0.9 / brightest) / least_gain
