r"""The tuning file of a sensor, as libcamera and Raspberry Pi's camera software read it, as the figures of a camera.

Such a file (``imx477.json``) states, on a scale of 16 bits whatever the sensor has:

- ``rpi.black_level``: the black level b, so that V = 65535 - b codes lie between black and white;
- ``rpi.ccm``: matrices from white-balanced camera RGB to linear sRGB, by colour temperature;
- ``rpi.awb``: white points R/G and B/G by colour temperature, whose reciprocals are the gains of red and blue;
- ``rpi.contrast``: the tone curve;
- ``rpi.alsc``: lens shading over a grid of cells, as the gains that undo it: ``luminance_lut`` L for green, and by
  colour temperature ``calibrations_Cr`` and ``calibrations_Cb``, by which red and blue take more. Each table counts
  relative to its minimum (``alsc.cpp``), and the light that arrives is 1 / (L Cr), 1 / L and 1 / (L Cb).
  ``luminance_strength``, how far the software wants to undo it, does not matter;
- ``rpi.noise``: a and s of the standard deviation :math:`a + s \sqrt{S}` of a signal of S codes above black, at an
  analogue gain of 1. Both grow with the root of the gain g (``noise.cpp``), and the calibration subtracts the black
  level but does not stretch what is left (``ctt_noise.py``), so that with white = 1

.. math:: \mathrm{shot\_var} = g\,(s^2 / V + \tfrac{4}{5} c), \qquad
          \mathrm{read\_var} = g\,(a^2 / V^2 + \tfrac{4}{15} c), \qquad c = 2 a s / V^{3/2},

where :math:`\sqrt{y}` of the mixed term c is replaced by its line of least squares, 4/15 + 4/5 y. It is absent in most
files, whose a is 0. ISO is 100 g, as the DNGs of these systems say.

Source: the controllers ``src/ipa/rpi/controller/rpi`` of https://github.com/raspberrypi/libcamera and the calibration
in ``utils/raspberrypi/ctt``. Version 1 of the format has the same entries in one mapping, version 2 in a list.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.camera.lights import REFERENCE

_CODES = 65535
"""The largest number on the files' scale."""
_MAX_BYTES = 2**24
_GRIDS = {192: (12, 16), 1024: (32, 32)}
"""Rows and columns of a table of shading by the number of its cells: those of the Pi 4 and of the Pi 5."""
_HIGHEST_GAIN = 16.0
"""Analogue gain up to which noise is stated if the file lists no gains."""


def read_tuning(path: str | Path) -> dict[str, Any]:
    """Read the figures of a tuning file as the arguments of :class:`rawaug.Camera`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no tuning file, is of a monochrome sensor, or does not state what a camera needs.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such tuning file")
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path}: is larger than any tuning file; give that of the sensor, such as imx477.json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not JSON ({error}); give a tuning file of libcamera") from None

    parts = _algorithms(content, path)
    if "rpi.ccm" not in parts:
        raise ValueError(f"{path}: has no rpi.ccm; the sensor is monochrome, or its colours are not calibrated")
    for name in ("rpi.black_level", "rpi.awb"):
        if name not in parts:
            raise ValueError(
                f"{path}: has no {name}, which a camera needs; the figures of a sheet can be given in YAML"
            )

    try:
        black = float(parts["rpi.black_level"]["black_level"])
        matrices = {float(entry["ct"]): entry["ccm"] for entry in parts["rpi.ccm"]["ccms"]}
        kelvin, red, blue = np.asarray(parts["rpi.awb"]["ct_curve"], dtype=np.float64).reshape(-1, 3).T
        figures: dict[str, Any] = {
            "name": path.stem,
            "matrix": {
                f"{ct:g}": np.asarray(matrix, dtype=np.float64).reshape(3, 3) for ct, matrix in matrices.items()
            },
            "matrix_is": "camera_to_srgb",
            "black_level": black,
            "white_level": _CODES,
            "source": f"{path.name}, a tuning file of libcamera",
        }
        shaded: list[float] = []
        if "luminance_lut" in parts.get("rpi.alsc", {}):
            figures["shading"] = _shading(parts["rpi.alsc"])
            shaded = [float(ct) for ct in figures["shading"] if ct != REFERENCE]

        balance = {}
        for ct in sorted({*kelvin.tolist(), *matrices, *shaded}):
            gains = [1.0 / np.interp(ct, kelvin, red), 1.0, 1.0 / np.interp(ct, kelvin, blue)]
            balance[f"{ct:g}"] = [float(gain) for gain in gains]
        figures["white_balance"] = balance

        if "rpi.noise" in parts:
            figures["noise"] = _levels(parts, _CODES - black)
        if "gamma_curve" in parts.get("rpi.contrast", {}):
            curve = np.asarray(parts["rpi.contrast"]["gamma_curve"], dtype=np.float64).reshape(-1, 2)
            figures["tone"] = (curve / _CODES).tolist()
    except (KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{path}: is no tuning file as libcamera reads it ({type(error).__name__}: {reason})"
        ) from None
    return figures


def _algorithms(content: Any, path: Path) -> dict[str, Any]:
    """List the entries of either version by name."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: must hold entries such as rpi.ccm, as a tuning file of libcamera does")

    version = content.get("version", 1.0)
    if version == 1.0:
        return dict(content)
    if version != 2.0 or not isinstance(content.get("algorithms"), list):
        raise ValueError(f"{path}: is of version {version!r:.20}; versions 1 and 2 are read")

    parts: dict[str, Any] = {}
    for entry in content["algorithms"]:
        if isinstance(entry, Mapping):
            parts.update(entry)
    return parts


def _levels(parts: Mapping[str, Any], full_scale: float) -> dict[float, list[float]]:
    """Compute the variances by ISO, at an analogue gain of 1 and at the highest."""
    constant, slope = float(parts["rpi.noise"]["reference_constant"]), float(parts["rpi.noise"]["reference_slope"])
    mixed = 2.0 * constant * slope / full_scale**1.5
    shot_var = slope**2 / full_scale + 0.8 * mixed
    read_var = constant**2 / full_scale**2 + mixed * 4.0 / 15.0

    highest = _HIGHEST_GAIN
    modes = _exposure_modes(parts.get("rpi.agc", {}))
    if modes:
        highest = max(float(gain) for gain in modes[0]["gain"])

    levels = {}
    for gain in (1.0, highest):
        levels[100.0 * gain] = [gain * shot_var, gain * read_var]
    if not math.isfinite(shot_var + read_var) or highest < 1.0:
        raise ValueError("rpi.noise or the gains of rpi.agc are out of range")
    return levels


def _shading(alsc: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Compute the light that arrives, three tables ``(3, rows, columns)`` by colour temperature."""
    luminance = _cells(alsc["luminance_lut"])
    red = {float(entry["ct"]): _cells(entry["table"]) for entry in alsc.get("calibrations_Cr", [])}
    blue = {float(entry["ct"]): _cells(entry["table"]) for entry in alsc.get("calibrations_Cb", [])}
    if set(red) != set(blue):
        raise ValueError("rpi.alsc states red and blue at different temperatures")
    if not red:  # the same for all colours, in any light
        return {REFERENCE: (1.0 / luminance).round(4).tolist()}

    tables = {}
    for ct in red:
        gains = np.stack([luminance * red[ct], luminance, luminance * blue[ct]])
        tables[f"{ct:g}"] = (gains.min() / gains).round(4).tolist()
    return tables


def _cells(table: Any) -> np.ndarray[Any, Any]:
    """Arrange a table of gains by rows and columns, relative to its minimum."""
    gains = np.asarray(table, dtype=np.float64)
    if gains.size not in _GRIDS or not gains.min() > 0:
        raise ValueError(f"rpi.alsc has a table of {gains.size} gains; those of 16 x 12 and 32 x 32 cells are read")
    return (gains / gains.min()).reshape(_GRIDS[gains.size])


def _exposure_modes(agc: Mapping[str, Any]) -> list[Any]:
    """List the exposure modes of the automatic gain, the normal one first."""
    channel = agc
    if "channels" in agc:
        channel = agc["channels"][0]
    modes = channel.get("exposure_modes", {})
    return [modes[name] for name in sorted(modes, key=lambda name: name != "normal")]
