r"""Simulated phones with the structure of SIDD: scenes, instances, five phones, lights, brightness and ISO.

    clean = min(s e A_T L(x) / max(A_T 1), 1) at the sites,   noisy = Q(k Poisson(clean / k) + N(0, r))
    srgb  = t(c(C_U diag(d g_U) demosaic(clean / s^q)))

The scene L(x) is a photograph's linear light and A_T the phone's matrix in a light of temperature T
(:mod:`rawaug.data.scenes`). An instance has a light T, an exposure e and an ISO, whose published noise levels are
(k, r); the phone has a lens shading s and a sensor of ten bits with a black level (Q). Clean RAW stands for the mean of
a burst: it is not quantised.

The renderer does not know the light. It takes it to have the temperature U, and lifts dark frames. It does both only
partly and with errors, as the phone's own law says (:class:`Rendering`), in mired and in stops:

    10^6 / U = 10^6 / T0 + a (10^6 / T - 10^6 / T0) + error,    log2 d = b log2(target / mean) + error

so that lamps stay warm and dim rooms dark, and a picture says something about the gains that made it. Each phone has a
saturation in its matrix C, and its own tone curve t.

docs/datasets.md says what is as in SIDD and what is not. None of this shares code with the ISPs that are fitted to it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.bayer import CFA, demosaic, mosaic
from rawaug.data.frames import Frames
from rawaug.data.pairs import DATASETS, Pair
from rawaug.data.scenes import camera_in_light, draw_window, scene_files
from rawaug.data.sidd_scenes import HELD_BACK, PHONES, parse_label
from rawaug.io import RawFrame, encode_srgb
from rawaug.seeding import keyed_generator

_FRAME = (512, 512)
"""Height and width of a frame: four patches of 256 x 256."""
WHITE = 1023
"""The saturated digital number of ten bits."""
LIGHTS = (3200, 4400, 5500)
"""Colour temperatures in kelvin, SIDD's own."""
_BRIGHTNESS = {"N": (0.0, 1.0), "L": (1.0, 2.5)}
"""Limits of normal and low exposures, in stops below the one that takes white to the sensor's white."""
_TAKEN_FOR_NEUTRAL = 6500.0
"""T0, the temperature in kelvin that a renderer falls back on."""
SHOTS = ("010", "011")
"""The numbers of an instance's two frames, which differ by their noise."""
_MOST_LIFT = 16.0
_SCENE_ENDS = (33, 54, 73, 94, 117, 142, 165, 188, 194, 200)
"""The last instance of each scene. With SIDD's held-back instances left out, 28 are of scene 001 and 92 of 001 to 005,
so that 56 and 184 pairs are whole scenes."""


class Shading(NamedTuple):
    """The fall-off ``1 / (1 + quadratic r^2 + quartic r^4)`` around (y, x), in half diagonals from the centre."""

    y: float
    x: float
    quadratic: float
    quartic: float


class Rendering(NamedTuple):
    """How a phone renders.

    Args:
        adaptation: share a of the way from neutral to the light that white balance goes, in mired.
        balance_error: standard deviation of white balance along the lights, in mired.
        tint_error: standard deviation of red and blue gains off that line, relative.
        lift: share b of the way to the target that the digital gain goes, in stops.
        target: the mean of balanced RAW that the renderer aims at.
        lift_error: standard deviation of the digital gain, in stops.
        shading_removed: q, the exponent of the shading that is divided out.
        saturation: factor on the distance from grey.
        brightness, contrast: parameters of the tone curve, see :func:`phone_curve`.
    """

    adaptation: float
    balance_error: float
    tint_error: float
    lift: float
    target: float
    lift_error: float
    shading_removed: float
    saturation: float
    brightness: float
    contrast: float


class Phone(NamedTuple):
    """A phone, with SIDD's code, name and pattern; ``noise`` has (shot_var, read_var) by ISO."""

    code: str
    name: str
    cfa: CFA
    black: int
    xyz_to_camera: Sequence[Sequence[float]]
    noise: dict[int, tuple[float, float]]
    isos: tuple[int, ...]
    shading: Shading
    rendering: Rendering


class Shot(NamedTuple):
    """The values that are drawn for an instance: light in kelvin, exposure in stops, ISO, and the renderer's errors.

    ``balance_error`` is in mired, ``tint_error`` in the logarithms of the red and blue gains, ``lift_error`` in stops.
    """

    kelvin: int
    stops: float
    iso: int
    balance_error: float
    tint_error: tuple[float, float]
    lift_error: float


def _phone(
    code: str,
    black: int,
    xyz_to_camera: Sequence[int],
    noise: dict[int, tuple[float, float]],
    isos: Sequence[int],
    shading: Shading,
    rendering: Rendering,
) -> Phone:
    name, cfa = PHONES[code]
    matrix = []
    for row in (0, 3, 6):
        matrix.append([value / 1e4 for value in xyz_to_camera[row : row + 3]])

    return Phone(code, name, cfa, black, matrix, noise, tuple(isos), shading, rendering)


_PHONES = [
    _phone(
        "GP",
        64,
        (5302, 1083, -728, -5320, 14112, 1699, -863, 2371, 5136),
        {
            100: (0.000228, 2e-6),
            400: (0.000886, 5e-6),
            800: (0.001764, 1.2e-5),
            1600: (0.003519, 4.5e-5),
            3200: (0.007029, 1.79e-4),
        },
        (50, 100, 200, 400, 800, 1600, 3200),
        Shading(0.03, -0.05, 0.55, 0.35),
        Rendering(0.85, 6.0, 0.015, 0.55, 0.16, 0.08, 1.0, 1.05, 0.25, 0.35),
    ),
    _phone(
        "IP",
        64,
        (9927, -3704, -1024, -3935, 12758, 1257, -389, 1512, 4993),
        {100: (0.000702, 3e-6), 400: (0.000735, 3e-6), 800: (0.000723, 3e-6), 1600: (0.000687, 2e-6)},
        (50, 100, 200, 400, 800, 1600),
        Shading(-0.02, 0.02, 0.40, 0.20),
        Rendering(0.65, 5.0, 0.010, 0.50, 0.15, 0.06, 0.9, 1.00, 0.20, 0.25),
    ),
    _phone(
        "S6",
        32,
        (13699, -5767, -1384, -4449, 13879, 499, -467, 1691, 5892),
        {
            100: (0.000479, 2e-6),
            400: (0.001774, 2e-6),
            800: (0.003696, 2e-6),
            1600: (0.008211, 2e-6),
            3200: (0.01993, 2e-6),
        },
        (50, 100, 200, 400, 800, 1600, 3200),
        Shading(0.05, 0.04, 0.70, 0.30),
        Rendering(0.80, 8.0, 0.020, 0.60, 0.17, 0.10, 0.95, 1.20, 0.30, 0.45),
    ),
    _phone(
        "N6",
        64,
        (13292, -6142, -1268, -4095, 12890, 1283, -557, 1930, 5163),
        {
            100: (0.000473, 3e-6),
            400: (0.00176, 1.3e-5),
            800: (0.003476, 5.2e-5),
            1600: (0.006909, 2.08e-4),
            3200: (0.013773, 8.33e-4),
        },
        (50, 100, 200, 400, 800, 1600, 3200),
        Shading(-0.06, -0.03, 0.80, 0.45),
        Rendering(0.55, 9.0, 0.020, 0.45, 0.15, 0.10, 0.8, 0.95, 0.15, 0.20),
    ),
    _phone(
        "G4",
        64,
        (12782, -4059, -379, -478, 9066, 1413, 1340, 1513, 5176),
        {100: (0.000739, 2e-6), 400: (0.00186, 2e-6), 800: (0.003356, 6.3e-5)},
        (50, 100, 200, 400, 800),
        Shading(0.02, 0.06, 0.50, 0.50),
        Rendering(0.75, 7.0, 0.015, 0.55, 0.16, 0.08, 1.0, 1.10, 0.22, 0.35),
    ),
]
CAMERAS: dict[str, Phone] = {phone.code: phone for phone in _PHONES}
"""The phones by SIDD's code.

The noise is from the camera metadata of SIDD as published with Noise Flow (Abdelhamed et al., ICCV 2019). The matrices,
XYZ to camera for D65, are from LibRaw's table. S6 has that of the Galaxy S6; the other four are sensors of phones whose
matrices are published: GP Sony IMX219, IP Galaxy S7, N6 Galaxy S9, G4 OmniVision OV5647. Shading and rendering are
invented.
"""


def phone_noise(phone: Phone, iso: int) -> tuple[float, float]:
    """Look up (shot_var, read_var) at an ISO: interpolated in logarithms, and constant beyond the published ISOs."""
    isos = sorted(phone.noise)
    if iso <= isos[0]:
        return phone.noise[isos[0]]
    if iso >= isos[-1]:
        return phone.noise[isos[-1]]

    above = bisect_left(isos, iso)
    low, high = isos[above - 1], isos[above]
    share = math.log(iso / low) / math.log(high / low)
    levels = []
    for first, second in zip(phone.noise[low], phone.noise[high], strict=True):
        levels.append(math.exp((1.0 - share) * math.log(first) + share * math.log(second)))
    return levels[0], levels[1]


def phone_curve(linear: Tensor, brightness: float, contrast: float) -> Tensor:
    """Render linear light in [0, 1] as display values: ``d + b d (1 - d) - c d (1 - d)(1 - 2 d)``, d its sRGB code.

    ``brightness`` b lifts the middle, ``contrast`` c bends an S; the curve rises as long as ``b + c < 1``.
    """
    display = encode_srgb(linear)
    middle = display * (1.0 - display)
    return display + brightness * middle - contrast * middle * (1.0 - 2.0 * display)


class PhoneFrames(Frames[Pair]):
    """The frames of a split, 512 x 512: 320 for training, 40 for validation and 40 for test.

    Training has two frames of each of its 160 instances. Validation has one frame of each of SIDD's 40 held-back
    instances, and so has test, with other photographs, lights and ISO. Frames depend on (seed, split, instance) alone.

    Args:
        path: a folder of photographs (:func:`rawaug.data.scenes.scene_files`), or empty for the package's own.
        split: ``"train"``, ``"validation"`` or ``"test"``.
        seed: seed of all draws.
        size: height and width of the frames, even.

    Example:
        >>> frames = PhoneFrames("", "train")
        >>> len(frames), frames.names[0], frames.labels[0].phone
        (320, '0001_001_N6_00100_00100_5500_N_010', 'N6')
    """

    def __init__(
        self, path: str | Path = "", split: str = "test", seed: int = 0, size: tuple[int, int] = _FRAME
    ) -> None:
        self.path = str(path)
        self.split = split
        self.seed = seed
        self.size = size
        self.files = scene_files(path, split)

        numbers: tuple[str, ...] = SHOTS
        if split == "test":
            numbers = SHOTS[:1]
        elif split == "validation":
            numbers = SHOTS[1:]

        self.instances = []
        labels = []
        names = []
        for instance, shot, file in self._draw_instances():
            for number in numbers:
                self.instances.append((instance, shot, file))
                labels.append(parse_label(instance))
                names.append(f"{instance}_{number}")
        self.labels = labels
        super().__init__(names)

    def _draw_instances(self) -> list[tuple[str, Shot, Path]]:
        """Draw the name of each scene instance, what is drawn for it, and the photograph that it shows."""
        labels = _training_labels(self.seed) if self.split == "train" else _held_back_labels()
        order: list[int] = []
        instances: list[tuple[str, Shot, Path]] = []
        for number, scene, code in labels:
            generator = keyed_generator(self.seed, "phones", self.split, number)
            if not order:
                turn = keyed_generator(self.seed, "phones", self.split, "photographs", len(instances))
                order = torch.randperm(len(self.files), generator=turn).tolist()

            shot, brightness = _draw_shot(CAMERAS[code], generator)
            shutter = max(1, round(shot.iso * (1.0 if brightness == "N" else 1.0 / 3.0)))
            name = f"{number:04d}_{scene:03d}_{code}_{shot.iso:05d}_{shutter:05d}_{shot.kelvin}_{brightness}"
            instances.append((name, shot, self.files[order.pop()]))
        return instances

    def stamp(self, index: int) -> str:
        _, _, file = self.instances[index]
        height, width = self.size
        return f"{self.names[index]} seed {self.seed}, {height} x {width} of {file.name} {file.stat().st_size}"

    def read(self, index: int) -> Pair:
        instance, shot, file = self.instances[index]
        generator = keyed_generator(self.seed, "phones window", self.split, instance)
        scene = draw_window(file, self.size, generator, self.max_pixels)

        phone = CAMERAS[self.labels[index].phone]
        noise = keyed_generator(self.seed, "phones noise", self.split, self.names[index])
        return take_shot(phone, scene, shot, noise, self.names[index])


def _training_labels(seed: int) -> list[tuple[int, int, str]]:
    """List the number, scene and phone of the training instances; five in a row are five different phones."""
    held_back = {int(name[:4]) for name in HELD_BACK}
    numbers = [number for number in range(1, _SCENE_ENDS[-1] + 1) if number not in held_back]
    codes = list(CAMERAS)

    labels = []
    for index, number in enumerate(numbers):
        block, position = divmod(index, len(codes))
        order = torch.randperm(len(codes), generator=keyed_generator(seed, "phones order", block)).tolist()
        labels.append((number, _scene_number(number), codes[order[position]]))
    return labels


def _held_back_labels() -> list[tuple[int, int, str]]:
    """List the number, scene and phone of SIDD's held-back instances."""
    labels = []
    for name in HELD_BACK:
        label = parse_label(name)
        labels.append((int(name[:4]), int(label.scene), label.phone))
    return labels


@cache
def _scene_number(number: int) -> int:
    return 1 + next(position for position, end in enumerate(_SCENE_ENDS) if number <= end)


def _draw_shot(phone: Phone, generator: torch.Generator) -> tuple[Shot, str]:
    """Draw the settings that an instance is taken with, and its brightness, N or L."""
    light, dim, exposure, level = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    errors = torch.randn(4, generator=generator, dtype=torch.float64).tolist()

    brightness = "N" if dim < 0.5 else "L"
    least, most = _BRIGHTNESS[brightness]
    law = phone.rendering
    shot = Shot(
        kelvin=LIGHTS[int(light * len(LIGHTS))],
        stops=least + exposure * (most - least),
        iso=phone.isos[int(level * len(phone.isos))],
        balance_error=law.balance_error * errors[0],
        tint_error=(law.tint_error * errors[1], law.tint_error * errors[2]),
        lift_error=law.lift_error * errors[3],
    )
    return shot, brightness


def take_shot(phone: Phone, scene: Tensor, shot: Shot, generator: torch.Generator, name: str = "phone") -> Pair:
    """Take a shot of a scene.

    Args:
        phone: one of :data:`CAMERAS`.
        scene: linear sRGB of the photograph in [0, 1], float32 ``(3, H, W)``, even sides of at least 4.
        shot: light, exposure, ISO and the renderer's errors.
        generator: generator of the noise.
        name: name of the pair.

    Returns:
        The pair: ``raw`` without noise, ``noisy``, the renderings of both, the white balance and the matrix that the
        renderer used, and the noise levels.

    Example:
        >>> shot = Shot(kelvin=3200, stops=1.0, iso=400, balance_error=0.0, tint_error=(0.0, 0.0), lift_error=0.0)
        >>> pair = take_shot(CAMERAS["IP"], torch.full((3, 64, 96), 0.5), shot, torch.Generator().manual_seed(0))
        >>> pair.clean.mosaic.shape, pair.srgb.shape, pair.cfa
        (torch.Size([1, 64, 96]), torch.Size([3, 64, 96]), <CFA.RGGB: 'RGGB'>)
    """
    clean = _expose(phone, scene, shot)

    shot_var, read_var = phone_noise(phone, shot.iso)
    electrons = torch.poisson(clean / shot_var, generator=generator)
    read_noise = torch.randn(clean.shape, generator=generator) * read_var**0.5
    noisy = _digitise(shot_var * electrons + read_noise, phone.black)

    gains = balance(phone, shot)
    lift = digital_gain(phone, clean, gains, shot)
    frame = RawFrame(
        clean,
        phone.cfa,
        white_balance=(float(gains[0] / gains[1]), 1.0, float(gains[2] / gains[1])),
        color_matrix=colour_matrix(phone, shot).float(),
        camera=phone.name,
        iso=float(shot.iso),
    )
    return Pair(
        name,
        frame,
        srgb=render_shot(phone, clean, gains, lift, shot),
        noisy=replace(frame, mosaic=noisy, noise_profile=(shot_var, read_var)),
        noisy_srgb=render_shot(phone, noisy, gains, lift, shot),
    )


def _expose(phone: Phone, scene: Tensor, shot: Shot) -> Tensor:
    """Compute the light at the sensor's sites before noise, ``(1, H, W)`` in [0, 1]."""
    matrix = camera_in_light(phone.xyz_to_camera, shot.kelvin)
    matrix = matrix / matrix.sum(dim=1).max()
    light = torch.einsum("ij,jhw->ihw", matrix.float(), scene)

    exposed = 2.0**-shot.stops * shading(phone.shading, *scene.shape[-2:]) * light
    return mosaic(exposed, phone.cfa).clamp(0.0, 1.0)


def balance(phone: Phone, shot: Shot) -> Tensor:
    """Compute the gains of R, G and B that the renderer uses, ``(3,)``, the least being 1."""
    response = camera_in_light(phone.xyz_to_camera, _taken_for(phone, shot)).sum(dim=1)
    red, blue = shot.tint_error
    gains = torch.tensor([math.exp(red), 1.0, math.exp(blue)], dtype=torch.float64) / response
    return gains / gains.min()


def colour_matrix(phone: Phone, shot: Shot) -> Tensor:
    """Compute the matrix from balanced camera RGB to linear sRGB, ``(3, 3)``; rows sum to 1 before saturation."""
    camera = camera_in_light(phone.xyz_to_camera, _taken_for(phone, shot))
    return torch.linalg.inv(camera / camera.sum(dim=1, keepdim=True))


def _taken_for(phone: Phone, shot: Shot) -> float:
    """Compute the colour temperature that the renderer assumes for the light, in kelvin."""
    neutral = 1e6 / _TAKEN_FOR_NEUTRAL
    shift = phone.rendering.adaptation * (1e6 / shot.kelvin - neutral)
    mired = neutral + shift + shot.balance_error
    return min(max(1e6 / mired, 2000.0), 20000.0)


def digital_gain(phone: Phone, clean: Tensor, gains: Tensor, shot: Shot) -> float:
    """Compute the factor on all channels that lifts a dark frame, 1 or more."""
    law = phone.rendering
    balanced = demosaic(clean[None], phone.cfa)[0].mean(dim=(1, 2)) * gains.float()
    mean = float(balanced.mean().clamp_min(1e-4))
    stops = law.lift * math.log2(law.target / mean) + shot.lift_error
    return min(max(2.0**stops, 1.0), _MOST_LIFT)


def render_shot(phone: Phone, raw: Tensor, gains: Tensor, lift: float, shot: Shot) -> Tensor:
    """Develop a mosaic ``(1, H, W)`` as the phone does: sRGB, uint8 ``(3, H, W)``."""
    law = phone.rendering
    flat = raw / shading(phone.shading, *raw.shape[-2:]) ** law.shading_removed
    camera = demosaic(flat[None], phone.cfa, "malvar")[0]
    balanced = (camera * (lift * gains.float())[:, None, None]).clamp(0.0, 1.0)

    matrix = colour_matrix(phone, shot)
    luma = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    saturated = law.saturation * matrix + (1.0 - law.saturation) * (luma @ matrix)
    linear = torch.einsum("ij,jhw->ihw", saturated.float(), balanced).clamp(0.0, 1.0)

    display = phone_curve(linear, law.brightness, law.contrast)
    return (display * 255.0).round().clamp(0, 255).to(torch.uint8)


def shading(law: Shading, height: int, width: int) -> Tensor:
    """Compute the relative illumination of a frame, ``(H, W)``, 1 at its centre."""
    half_diagonal = math.hypot(height, width) / 2.0
    y = (torch.arange(height) + 0.5 - height / 2.0) / half_diagonal - law.y
    x = (torch.arange(width) + 0.5 - width / 2.0) / half_diagonal - law.x
    square = y[:, None] ** 2 + x**2
    return 1.0 / (1.0 + law.quadratic * square + law.quartic * square**2)


def _digitise(light: Tensor, black: int) -> Tensor:
    """Round to digital numbers of ten bits, and scale back to black 0, white 1."""
    numbers = (light * (WHITE - black) + black).round().clamp(0, WHITE)
    return (numbers - black) / (WHITE - black)


@DATASETS.register("phones")
def open_phones(path: str | Path = "", split: str = "test", seed: int = 0) -> PhoneFrames:
    """Open ``phones:`` with the package's photographs, or ``phones:DIR`` with a folder's; a split may come last."""
    return PhoneFrames(path, split, seed)
