r"""A camera of your own, defined by the figures of its data sheet: no RAW file is needed.

A camera is known in one light or several. In each it has a matrix C from linear sRGB to white-balanced camera RGB,
whose rows sum to 1, and gains g (green 1) that make white grey. With S from linear sRGB to XYZ and B(L) Bradford's
adaptation from the light's white point to D65, the matrix from XYZ under that light is

.. math:: X = \mathrm{diag}(1 / g) \; C \; S^{-1} B(L) .

In other light the matrices of the neighbouring lights are mixed, with the weights of :mod:`rawaug.camera.lights`,

.. math:: C = \sum_i w_i C_i, \qquad g(L) = \frac{(X L)_G}{X L}, \quad X = \sum_i w_i X_i,

so that the gains of a light on the data sheet are exactly those stated.

*Noise.* A gain of K digital numbers (DN) per electron, read noise of :math:`\sigma` DN and V = white level - black
level give the variances on the scale white = 1:

.. math:: \mathrm{shot\_var} = K / V, \qquad \mathrm{read\_var} = \sigma^2 / V^2 .

If ``bits`` is given, RAW is rounded to whole DN. Noise that is measured on RAW files contains this rounding, a variance
of :math:`1 / (12 V^2)`, so it is subtracted from ``read_var`` before the rounding adds it again. A file of whole DN
holds nothing below 0 DN, which is where the noise of black is clipped: at -black level / V.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA, PATTERNS
from rawaug.camera.lights import compute_mired, light_xyz, mix_by_light, weights_in_light
from rawaug.camera.matrices import gains_in_light, load_cameras
from rawaug.camera.sheet_colour import Anchor, MatrixKind, check_colours, read_anchors, read_shading
from rawaug.camera.sheet_noise import Level, check_levels, is_number, read_levels
from rawaug.camera.softness import MTF50
from rawaug.camera.transfer import measure_photon_transfer
from rawaug.camera.tuning import read_tuning
from rawaug.errors import count_of
from rawaug.files import read_yaml
from rawaug.registry import suggest

_YAML_EXTENSIONS = (".yaml", ".yml")
_TUNING_EXTENSION = ".json"
"""Extension of a tuning file of libcamera."""

NoiseUnit = Literal["variance", "DN"]

_LARGEST = 1e9
"""No figure of a camera is larger."""


@dataclass(frozen=True)
class Camera:
    """A camera of your own, defined by the figures of its data sheet.

    Args:
        name: maker and model, for reports.
        matrix: 3 x 3, or a mapping of lights to such matrices. A light is ``"A"``, ``"D50"``, ``"D55"``, ``"D65"``,
            ``"D75"``, a lamp of :data:`rawaug.camera.lights.LAMPS`, or a colour temperature in kelvin. A single matrix
            is that of D65.
        matrix_is: direction of the matrix. ``"xyz_to_camera"``: CIE XYZ under the light to camera RGB before white
            balance, as ColorMatrix in a DNG. ``"srgb_to_camera"``: linear sRGB to white-balanced camera RGB.
            ``"camera_to_srgb"``: the opposite, the colour correction matrix of most ISPs.
        white_balance: gains of R, G and B that make white grey, or a mapping of lights to them. They may be left out
            with ``"xyz_to_camera"``, which determines them.
        cfa: pattern of the sensor.
        black_level: black level in DN; four equal ones, as a DNG has for its planes, are one.
        white_level: DN at which the sensor saturates; by default the largest number of ``bits``.
        bits: depth of the RAW, 1 to 16; RAW is then rounded to whole DN. By default nothing is rounded.
        noise: levels by ISO. Each is ``(shot_var, read_var)``, variances on the scale white = 1, or ``(K, sigma)`` in
            DN, as ``noise_in`` says; a mapping with these names needs no ``noise_in``. It may also state banding,
            ``row`` and ``column`` as deviations in DN, or ``row_var`` and ``column_var``; ``lambda``, Tukey's shape of
            the read noise; and ``hot``, the share of hot pixels. A single level without an ISO may be given as it is.
            None if unknown.
        noise_in: unit of levels without names, ``"variance"`` or ``"DN"``.
        tone: name of one of the ISP's tone curves, or points ``(linear light, value of the picture)``, both from 0 to 1
            and ascending. By default any of the ISP's curves is drawn.
        source: where the figures are from, for reports.
        shading: the share of light that arrives, above 0 to 1: a table of rows and columns over the frame, or three of
            them for R, G and B; or a mapping of lights to these. None for none.
        blur: softness of lens, low-pass filter and pixels: the standard deviation, from 0 to 1 pixel, of a Gaussian
            that makes photographs for the screen as soft as RAW of this camera, or the lowest and the highest. By
            default they are left as they are.
        mtf50: the same as the spatial frequency in cycles a pixel at which contrast is halved, at least 0.188, in place
            of ``blur``.

    Raises:
        ValueError: if a figure is missing, of another shape or out of range; the message names it.

    Example:
        >>> camera = Camera(
        ...     "Maker M1",
        ...     matrix=[[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]],
        ...     matrix_is="camera_to_srgb",
        ...     white_balance={"A": (1.3, 1.0, 2.6), "D65": (2.1, 1.0, 1.7)},
        ...     cfa="GRBG",
        ...     black_level=64,
        ...     bits=10,
        ...     noise={100: {"K": 0.12, "sigma": 1.1}, 800: {"K": 0.96, "sigma": 2.4}},
        ... )
        >>> [f"{variance:.3g}" for variance in camera.levels[0][1:3]]
        ['0.000125', '1.32e-06']
    """

    name: str
    _: KW_ONLY
    matrix: Any
    matrix_is: MatrixKind
    white_balance: Any = None
    cfa: str = "RGGB"
    black_level: float = 0.0
    white_level: float | None = None
    bits: int | None = None
    noise: Any = None
    noise_in: NoiseUnit = "variance"
    tone: Any = None
    source: str | None = None
    shading: Any = None
    blur: Any = None
    mtf50: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise ValueError(f"a camera needs a name, got {self.name!r:.100}")

        # Everything that was given is kept as plain values, so that a camera can be printed, compared and stored.
        for field in fields(self):
            object.__setattr__(self, field.name, _plain(getattr(self, field.name)))
            for number in _numbers(getattr(self, field.name)):
                if abs(number) > _LARGEST:
                    raise self._error(field.name, f"has a number beyond {_LARGEST:g}, as no camera has")

        if isinstance(self.black_level, list) and len(self.black_level) == 4 and len(set(self.black_level)) == 1:
            object.__setattr__(self, "black_level", self.black_level[0])  # one for each plane, as in a DNG

        self._check_choices()
        self._check_grid()
        self._check_blur()
        self.inverse_curve(2)  # raises ValueError for points of the tone curve
        try:
            check_colours(self.anchors(), self.matrix_is, self.white_balance is not None)
            check_levels(self.levels, self.quantum)
            self.shading_by_light()
        except ValueError as error:
            raise ValueError(f"camera {self.name!r}: {error}") from None

    def _check_choices(self) -> None:
        if self.matrix_is not in get_args(MatrixKind):
            raise self._error("matrix_is", f"must be one of {', '.join(get_args(MatrixKind))}, got {self.matrix_is!r}")
        if self.noise_in not in get_args(NoiseUnit):
            raise self._error("noise_in", f"must be variance or DN, got {self.noise_in!r}")

        patterns = [*CFA.__members__, *PATTERNS]
        if self.cfa not in patterns:
            capitals = str(self.cfa).upper()
            hint = f"; did you mean {capitals!r}?" if capitals in patterns else ""
            raise self._error(
                "cfa", f"is unknown: {self.cfa!r:.40}; use one of {', '.join(dict.fromkeys(patterns))}{hint}"
            )

    def _check_grid(self) -> None:
        if self.bits is not None and (not isinstance(self.bits, int) or not 1 <= self.bits <= 16):
            raise self._error("bits", f"must be a whole number from 1 to 16, got {self.bits!r}")

        for key in ("black_level", "white_level"):
            value = getattr(self, key)
            if value is not None and not (is_number(value) and value >= 0):
                raise self._error(key, f"must be a number of DN, at least 0, got {value!r:.100}")

        if self.white_level is None and self.bits is None:
            if self.black_level:
                raise self._error("black_level", "needs bits or white_level as well")
            return

        if not self.full_scale > 0:
            raise self._error("black_level", f"{self.black_level:g} DN is not below white, {self.white:g} DN")
        if self.bits is not None and self.white > 2**self.bits - 1:
            raise self._error("white_level", f"{self.white:g} DN does not fit {count_of(self.bits, 'bit')}")

    def _check_blur(self) -> None:
        if self.mtf50 is not None:
            if self.blur is not None:
                raise self._error("mtf50", "is another form of blur; leave one of them out")
            if not (is_number(self.mtf50) and self.mtf50 >= MTF50):
                raise self._error("mtf50", f"must be at least {MTF50:.3f} cycles a pixel, got {self.mtf50!r:.100}")
        if self.blur is None:
            return

        ends = self.blur if isinstance(self.blur, list) else [self.blur, self.blur]
        if len(ends) != 2 or not all(is_number(end) and 0 <= end <= 1 for end in ends) or ends[0] > ends[1]:
            rule = "must be a number of pixels from 0 to 1, or the lowest and the highest"
            raise self._error("blur", f"{rule}, got {self.blur!r:.100}")

    @property
    def blur_range(self) -> tuple[float, float]:
        """The least and the largest standard deviation of the blur, in pixels."""
        if self.mtf50 is not None:
            return MTF50 / self.mtf50, MTF50 / self.mtf50
        if self.blur is None:
            return 0.0, 0.0
        if isinstance(self.blur, list):
            return self.blur[0], self.blur[1]
        return self.blur, self.blur

    def _error(self, key: str, reason: str) -> ValueError:
        return ValueError(f"camera {self.name!r}: {key} {reason}")

    # -- digital numbers ----------------------------------------------------------------------------------------------

    @property
    def white(self) -> float:
        """The DN at which the sensor saturates; 1 if neither ``white_level`` nor ``bits`` is given."""
        if self.white_level is not None:
            return float(self.white_level)
        return 1.0 if self.bits is None else float(2**self.bits - 1)

    @property
    def full_scale(self) -> float:
        """V, the DN from black to white."""
        return self.white - self.black_level

    @property
    def quantum(self) -> float:
        """The step of the rounding on the scale white = 1; 0 if nothing is rounded."""
        return 0.0 if self.bits is None else 1.0 / self.full_scale

    # -- noise --------------------------------------------------------------------------------------------------------

    @property
    def levels(self) -> list[Level]:
        """The noise by ISO, ascending, as variances with white = 1; empty if it is not known."""
        full_scale = None if self.bits is None and self.white_level is None else self.full_scale
        return read_levels(self.noise, self.noise_in == "DN", full_scale)

    def noise_spec(self) -> dict[str, Any] | None:
        """The noise as a name with settings, which :func:`rawaug.noise.noise_model` reads; None if unknown.

        It includes the grid of digital numbers, which begins at 0 DN, if ``bits`` is given.
        """
        if not self.levels:
            return None

        rows = []
        for level in self.levels:
            rows.append({key: value for key, value in level._asdict().items() if value is not None})

        settings: dict[str, Any] = {"camera": self.name, "levels": rows}
        if self.quantum:
            settings["quantum"] = self.quantum
            settings["lowest"] = -self.black_level / self.full_scale
        return {"name": "MeasuredNoise", "settings": settings}

    # -- colour -------------------------------------------------------------------------------------------------------

    def anchors(self) -> list[Anchor]:
        """The camera in each light that its figures name, warmest first."""
        return read_anchors(self.matrix, self.matrix_is, self.white_balance)

    def matrix_for(self, white_balance: Sequence[float]) -> Tensor:
        """Compute the matrix ``(3, 3)`` from linear sRGB to white-balanced camera RGB in the light of as-shot gains.

        It is the matrix of the colour temperature, on the Planckian or daylight locus, whose gains are nearest in
        logarithms.
        """
        mireds = np.linspace(100.0, 500.0, 81)
        lights = torch.stack([light_xyz(f"{1e6 / mired:.6f}") for mired in mireds])

        _, anchor_mireds, matrices, _, from_xyz = zip(*self.anchors(), strict=True)
        weights = torch.from_numpy(weights_in_light(anchor_mireds, compute_mired(lights.numpy())))
        gains = gains_in_light(torch.einsum("bn,nij->bij", weights, torch.stack(from_xyz)), lights).clamp_min(1e-6)

        stated = torch.tensor(white_balance, dtype=torch.float64)
        distance = (gains.log() - (stated / stated[1]).log()).square().sum(dim=1)
        nearest = weights[int(distance.argmin())]
        return torch.einsum("n,nij->ij", nearest, torch.stack(matrices))

    # -- lens ---------------------------------------------------------------------------------------------------------

    def shading_in(self, light: str) -> Tensor | None:
        """Get the share of light ``(3, rows, columns)`` that arrives in R, G and B, in a light; None if not stated."""
        by_light = self.shading_by_light()
        if not by_light:
            return None
        return mix_by_light(by_light, light)

    def shading_by_light(self) -> dict[str, Tensor]:
        """Get the tables ``(3, rows, columns)`` of each light of the sheet; none if no shading is stated."""
        return read_shading(self.shading)

    # -- tone ---------------------------------------------------------------------------------------------------------

    def inverse_curve(self, nodes: int) -> Tensor | None:
        """Linear light ``(nodes,)`` as a function of the picture's values; None unless ``tone`` is points."""
        if self.tone is None or isinstance(self.tone, str):
            return None

        try:
            points = np.asarray(self.tone, dtype=np.float64)
        except (TypeError, ValueError):
            points = np.empty(0)

        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            points = np.zeros((2, 2))

        ascending = bool((np.diff(points, axis=0) > 0).all())
        if not ascending or tuple(points[0]) != (0.0, 0.0) or tuple(points[-1]) != (1.0, 1.0):
            rule = "must be a name, or ascending points (linear, value) from (0, 0) to (1, 1)"
            raise self._error("tone", f"{rule}, got {self.tone!r:.100}")

        values = np.linspace(0.0, 1.0, nodes)
        return torch.from_numpy(np.interp(values, points[:, 1], points[:, 0])).float()

    # -- files --------------------------------------------------------------------------------------------------------

    def to_json(self) -> dict[str, Any]:
        """Write the figures as plain values, without those at their defaults; :meth:`from_json` reads them back."""
        figures = asdict(self)
        for field in fields(self):
            if figures[field.name] == field.default:
                del figures[field.name]
        return figures

    @classmethod
    def from_json(cls, content: Any, where: str = "camera") -> Camera:
        """Make a camera from plain values.

        Args:
            content: a mapping with the names of the arguments.
            where: text at the beginning of the messages.

        Raises:
            ValueError: if a key is unknown or missing, or a figure is wrong.
        """
        keys = [field.name for field in fields(cls)]
        if not isinstance(content, Mapping):
            raise ValueError(f"{where}: must hold keys and values, {', '.join(keys)}")

        for key in content:
            if key not in keys:
                raise ValueError(f"{where}: unknown key {key!r:.80}; use {', '.join(keys)}{suggest(key, keys)}")

        for key in ("name", "matrix", "matrix_is"):
            if key not in content:
                raise ValueError(f"{where}: has no {key}")

        try:
            return cls(**content)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera from a YAML file with the names of the arguments as keys, or from a tuning file (``.json``).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not YAML, or a figure is wrong.
        """
        if Path(path).suffix.lower() == _TUNING_EXTENSION:
            return cls.from_tuning(path)
        return cls.from_json(read_yaml(path, "camera"), str(path))

    @classmethod
    def from_tuning(cls, path: str | Path, cfa: str = "RGGB") -> Camera:
        """Read a sensor's tuning file, such as libcamera's and Raspberry Pi's ``imx477.json``, of version 1 or 2.

        It states the black level, matrices and white points by colour temperature, the noise by analogue gain (ISO is
        100 times the gain), the lens shading and the tone curve; see :mod:`rawaug.camera.tuning` for the formulas.

        Args:
            path: the file.
            cfa: pattern of the sensor, which the file does not state.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no tuning file, is of a monochrome sensor, or does not state what a camera needs.

        Example:
            >>> Camera.from_tuning("imx477.json").levels[0].shot_var  # doctest: +SKIP
            0.00012461
        """
        return cls.from_json({**read_tuning(path), "cfa": cfa}, str(path))

    @classmethod
    def measure(cls, darks: Sequence[Any], flats: Sequence[Any], camera: Camera | None = None) -> Camera:
        """Measure a camera on dark frames and pairs of flat ones: gain K, read noise sigma and row noise, by ISO.

        Grid and pattern are those of the files. :mod:`rawaug.camera.transfer` has the formulas.

        Args:
            darks: frames with the lens capped, :class:`rawaug.io.RawFrame`, at least two at each ISO.
            flats: frames of an even light, at least two at each level, and several levels below white at each ISO.
            camera: name and colours to take; by default those that the files state.

        Returns:
            The camera. Its ``source`` says the intervals of 95 %, and what was left out and why.

        Raises:
            ValueError: if nothing can be measured, the frames differ, or no colours are known.

        Example:
            >>> camera = Camera.measure(darks, flats)  # doctest: +SKIP
            >>> camera.noise[100]["K"]  # doctest: +SKIP
            0.1203
        """
        noise, lines = measure_photon_transfer(darks, flats)
        frame = flats[0]
        figures: dict[str, Any] = {
            "cfa": str(frame.cfa),
            "black_level": float(np.mean(frame.black)),
            "white_level": float(frame.white),
            "bits": None if frame.floating else math.ceil(math.log2(frame.white + 1)),
            "noise": noise.get(None, noise),
            "noise_in": "variance",
            "source": "\n".join(["measured by photon transfer (EMVA 1288)", *lines]),
        }
        if camera is not None:
            return replace(camera, **figures)
        if not frame.color_known:
            raise ValueError(f"{frame.name}: states no colours; give a camera to take them from, by name or as a sheet")
        colours = {"matrix": frame.color_matrix, "matrix_is": "camera_to_srgb", "white_balance": frame.daylight}
        return cls(frame.camera, **colours, **figures)

    @classmethod
    def published(cls, name: str) -> Camera:
        """The published camera of this name; ValueError if it is not listed."""
        (matrix,) = load_cameras().select([name])
        return cls(name, matrix=matrix.tolist(), matrix_is="xyz_to_camera")


def is_camera_file(name: object) -> bool:
    """Whether a name or path is that of a camera's YAML file or of a tuning file."""
    return isinstance(name, (str, Path)) and Path(name).suffix.lower() in (*_YAML_EXTENSIONS, _TUNING_EXTENSION)


def as_camera(camera: str | Path | Camera) -> Camera:
    """Return a camera as it is, or read it from its YAML file, or find a published one by its name."""
    if isinstance(camera, Camera):
        return camera
    return Camera.load(camera) if is_camera_file(camera) else Camera.published(str(camera))


def own_cameras(info: Mapping[str, Any]) -> list[Camera]:
    """Get the user's own cameras that an ISP was made of, from its ``info``; other ISPs have none."""
    contents: Sequence[Mapping[str, Any]] = info.get("own_cameras", [])
    return [Camera.from_json(content, "the ISP's camera") for content in contents]


def _numbers(value: Any) -> Iterator[Any]:
    """Yield the numbers in plain values, keys included."""
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, Real):
        yield value


def _plain(value: Any) -> Any:
    """Convert arrays, tensors, tuples and mappings to lists and dicts of plain values."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (Tensor, np.ndarray)):
        return value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
