r"""Simulated RAW files of two DSLRs, rendered by LibRaw, with the structure of the paper's second table.

    d = round(k Poisson(s e A_T L(x) / k) + N(0, r)) at the sites,   srgb = LibRaw(d)

The scene L(x) and the camera's matrix in its light A_T are those of :mod:`rawaug.data.scenes`. The digital numbers are
written as a DNG, which LibRaw reads and renders like a real one: with its demosaicing, its colour, its tone curve, and
its scaling by the frame's own maximum, as in InvISP's protocol (Xing et al., CVPR 2021). A second kind of frames has
that rendering after a JPEG of quality 90.

The cameras are a Canon EOS 5D and a Nikon D700, with their matrices (LibRaw's table), bits and levels, and noise near
that of their lowest ISO (darktable's profiles). Scenes are in daylight; white balance errs by a few percent.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.bayer import CFA, mosaic
from rawaug.data.frames import Frames
from rawaug.data.pairs import DATASETS, Pair
from rawaug.data.scenes import camera_in_light, draw_window, scene_files
from rawaug.io import RawFrame
from rawaug.io.dng import write_dng
from rawaug.io.pictures import recode_jpeg
from rawaug.io.raw import read_raw_and_develop
from rawaug.seeding import keyed_generator

_FRAME = (512, 768)
FRAMES = {"train": 96, "validation": 12, "test": 24}
"""Number of frames of each camera in a split."""
_LIBRAW_THRESHOLD = 0.75
"""LibRaw's own ``adjust_maximum_thr``, which InvISP's published script leaves on."""
_JPEG_QUALITY = 90
_MIRED = (182.0, 22.0)
"""Mean and standard deviation of daylight's colour temperature."""
_BALANCE_ERROR = 0.03
"""Standard deviation of the logarithms of the as-shot red and blue gains."""
_STOPS = (0.0, 1.5)
"""Limits of the exposure, in stops below the one that takes white to the sensor's white."""


class Dslr(NamedTuple):
    """A camera: its matrix from XYZ for D65, pattern, levels in digital numbers, noise and lens.

    ``noise`` is (shot_var, read_var) at base ISO; ``vignetting`` is k of the lens shading ``(1 + k r^2)^-2``.
    """

    name: str
    cfa: CFA
    black: int
    white: int
    xyz_to_camera: tuple[tuple[float, float, float], ...]
    noise: tuple[float, float]
    vignetting: float


CAMERAS = {
    "canon": Dslr(
        "Canon EOS 5D",
        CFA.RGGB,
        127,
        3692,
        ((0.6347, -0.0479, -0.0972), (-0.8297, 1.5954, 0.2480), (-0.1968, 0.2131, 0.7649)),
        (3.0e-5, 2.0e-7),
        0.30,
    ),
    "nikon": Dslr(
        "Nikon D700",
        CFA.RGGB,
        0,
        15892,
        ((0.8139, -0.2171, -0.0663), (-0.8747, 1.6541, 0.2295), (-0.1925, 0.2008, 0.8093)),
        (2.0e-5, 1.0e-7),
        0.22,
    ),
}


class DslrFrames(Frames[Pair]):
    """The frames of one camera, 512 x 768: 96 for training, 12 for validation, 24 for test.

    Args:
        path: a folder of photographs (:func:`rawaug.data.scenes.scene_files`), or empty for the package's own.
        split: ``"train"``, ``"validation"`` or ``"test"``.
        camera: ``"canon"`` or ``"nikon"``.
        jpeg_quality: quality of the JPEG that the rendering is stored as; None keeps LibRaw's pixels.
        adjust_maximum_thr: LibRaw's scaling by the frame's own maximum; 0 turns it off.
        seed: seed of all draws.

    Example:
        >>> frames = DslrFrames("", "test", "nikon")
        >>> len(frames), frames.names[0]
        (24, 'nikon_test_000')
    """

    def __init__(
        self,
        path: str | Path = "",
        split: str = "test",
        camera: str = "canon",
        jpeg_quality: int | None = None,
        adjust_maximum_thr: float = _LIBRAW_THRESHOLD,
        seed: int = 0,
    ) -> None:
        if camera not in CAMERAS:
            raise ValueError(f"dslr: no camera {camera}; use one of {', '.join(CAMERAS)}")
        self.camera = camera
        self.split = split
        self.seed = seed
        self.jpeg_quality = jpeg_quality
        self.adjust_maximum_thr = adjust_maximum_thr
        self.files = scene_files(path, split)
        super().__init__([f"{camera}_{split}_{index:03d}" for index in range(FRAMES[split])])

    def stamp(self, index: int) -> str:
        file = self._file(index)
        rendering = f"quality {self.jpeg_quality} threshold {self.adjust_maximum_thr}"
        return f"{self.names[index]} seed {self.seed} {rendering} of {file.name} {file.stat().st_size}"

    def read(self, index: int) -> Pair:
        dslr = CAMERAS[self.camera]
        generator = keyed_generator(self.seed, "dslrs", self.names[index])
        scene = draw_window(self._file(index), _FRAME, generator, self.max_pixels)
        shot = take_frame(dslr, scene, generator, self.names[index])

        with TemporaryDirectory() as folder:
            file = Path(folder) / f"{self.names[index]}.dng"
            write_dng(file, shot)
            frame, srgb = read_raw_and_develop(file, self.adjust_maximum_thr)

        if self.jpeg_quality is not None:
            srgb = recode_jpeg(srgb, self.jpeg_quality)
        return Pair.of_frame(self.names[index], frame, srgb)

    def _file(self, index: int) -> Path:
        turn, position = divmod(index, len(self.files))
        order = torch.randperm(len(self.files), generator=keyed_generator(self.seed, "dslrs order", self.split, turn))
        return self.files[int(order[position])]


def take_frame(dslr: Dslr, scene: Tensor, generator: torch.Generator, name: str) -> RawFrame:
    """Take a RAW frame of a scene, linear sRGB ``(3, H, W)`` in [0, 1] with even sides, in daylight."""
    exposure = float(torch.rand((), generator=generator, dtype=torch.float64))
    light, red, blue = torch.randn(3, generator=generator, dtype=torch.float64).tolist()

    kelvin = 1e6 / max(_MIRED[0] + _MIRED[1] * light, 100.0)
    matrix = camera_in_light(dslr.xyz_to_camera, kelvin)
    response = matrix.sum(dim=1)
    camera = torch.einsum("ij,jhw->ihw", (matrix / response.max()).float(), scene)

    stops = _STOPS[0] + exposure * (_STOPS[1] - _STOPS[0])
    exposed = 2.0**-stops * _shading(dslr, *scene.shape[-2:]) * camera
    clean = mosaic(exposed, dslr.cfa).clamp(min=0.0)

    shot_var, read_var = dslr.noise
    electrons = torch.poisson(clean / shot_var, generator=generator)
    noisy = shot_var * electrons + torch.randn(clean.shape, generator=generator) * read_var**0.5

    step = 1.0 / (dslr.white - dslr.black)
    least = -dslr.black * step

    gains = response[1] / response
    daylight = camera_in_light(dslr.xyz_to_camera, 6504.0)
    neutral = daylight.sum(dim=1)
    return RawFrame(
        mosaic=((noisy / step).round() * step).clamp(least, 1.0),
        cfa=dslr.cfa,
        black=(float(dslr.black),) * 4,
        white=float(dslr.white),
        white_balance=(
            float(gains[0]) * math.exp(_BALANCE_ERROR * red),
            1.0,
            float(gains[2]) * math.exp(_BALANCE_ERROR * blue),
        ),
        daylight=tuple((neutral[1] / neutral).tolist()),
        color_matrix=torch.linalg.inv(daylight / neutral[:, None]).float(),
        camera=dslr.name,
        iso=100.0,
        name=name,
    )


def _shading(dslr: Dslr, height: int, width: int) -> Tensor:
    half_diagonal = math.hypot(height, width) / 2.0
    y = (torch.arange(height) + 0.5 - height / 2.0) / half_diagonal
    x = (torch.arange(width) + 0.5 - width / 2.0) / half_diagonal
    return (1.0 + dslr.vignetting * (y[:, None] ** 2 + x**2)) ** -2


def _open(
    path: str | Path = "",
    split: str = "test",
    camera: str = "canon",
    jpeg_quality: int | None = None,
    adjust_maximum_thr: float = _LIBRAW_THRESHOLD,
    seed: int = 0,
) -> DslrFrames:
    return DslrFrames(path, split, camera, jpeg_quality, adjust_maximum_thr, seed)


for _camera in CAMERAS:
    DATASETS.register(f"dslr_{_camera}")(partial(_open, camera=_camera))
    DATASETS.register(f"dslr_{_camera}_jpeg")(partial(_open, camera=_camera, jpeg_quality=_JPEG_QUALITY))
