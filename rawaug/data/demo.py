r"""Built-in data: photographs and dead leaves, and shots of both by a camera whose noise and colour are known.

    clean = Q(y),  noisy = Q(shot_var Poisson(y / shot_var) + N(0, read_var)),   y = mosaic(e s diag(g)^-1 M^-1 B L(x))
    srgb  = tone(M diag(g) demosaic(clean / s))

The picture x is the scene, linearised by L (IEC 61966-2-1); B is the blur of lens and optical low-pass filter. A shot
has an illuminant (gains g), an exposure e and an ISO (noise levels). The camera has a colour matrix M, lens shading s
that falls off like cos^4 around a point off centre, a GRBG sensor of 12 bits with a black level (Q), and a film-like
tone curve. It shares no code with the ISPs that are fitted to it: its noise (Poisson counts), its demosaicing (Malvar,
He and Cutler) and its tone curve are different.

The photographs are files from scikit-image's wheel; nothing is downloaded. The splits share no photograph and no source
of texture. As in practice, there are few RAW pairs and many sRGB pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple, overload

import torch
from torch import Tensor
from torch.utils.data import Dataset

from rawaug.bayer import CFA, demosaic, mosaic
from rawaug.data.drawn import dead_leaves
from rawaug.data.pairs import DATASETS, PICTURES, Pair, require_split
from rawaug.errors import extra
from rawaug.io import RawFrame, decode_srgb, encode_srgb, read_picture
from rawaug.seeding import keyed_generator

BLACK, WHITE = 512, 4095

NOISE_LEVELS = {
    100: (7.5e-4, 3.9e-6),
    200: (1.5e-3, 1.1e-5),
    400: (3.0e-3, 4.8e-5),
    800: (6.0e-3, 1.4e-4),
    1600: (1.2e-2, 6.1e-4),
    2500: (1.9e-2, 1.2e-3),
}
"""The levels (shot_var, read_var) by ISO."""

_COLOR_MATRIX = ((1.66, -0.53, -0.13), (-0.21, 1.55, -0.34), (0.02, -0.47, 1.45))
_ILLUMINANTS = ((2.25, 1.32), (2.10, 1.41), (1.98, 1.52), (1.85, 1.66), (1.72, 1.84), (1.55, 2.15))
"""Gains of red and blue from open shade over daylight to tungsten."""
_EXPOSURE = (0.75, 1.0)
_BLUR = 0.7
"""Standard deviation of the lens's point spread, in pixels."""
_SHADING_CENTRE = (0.06, -0.04)
_SHADING_FOCAL_LENGTH = 1.85
_SHOULDER, _CONTRAST = 1.2, 0.4


class DemoShot(NamedTuple):
    """The settings of one shot: gains of R, G, B; exposure; ISO, a key of NOISE_LEVELS; the noise's seed."""

    white_balance: tuple[float, float, float]
    exposure: float
    iso: int
    noise_seed: int


@dataclass(frozen=True)
class DemoCamera:
    """A camera with a sensor of pattern ``cfa``.

    Example:
        >>> picture = torch.randint(0, 256, (3, 64, 96), dtype=torch.uint8)
        >>> pair = DemoCamera().capture(picture, torch.Generator().manual_seed(0))
        >>> pair.clean.mosaic.shape, pair.noisy.mosaic.shape, pair.srgb.shape
        (torch.Size([1, 64, 96]), torch.Size([1, 64, 96]), torch.Size([3, 64, 96]))
    """

    cfa: CFA = CFA.GRBG

    def sample(self, generator: torch.Generator, iso: int | None = None) -> DemoShot:
        """Draw the parameters of a shot, including the ISO unless it is given."""
        red_to_blue, red, blue, exposure, level = torch.rand(5, generator=generator, dtype=torch.float64).tolist()

        # interpolate between two illuminants; real light deviates from their line by a few percent
        position = red_to_blue * (len(_ILLUMINANTS) - 1)
        k = int(position)
        t = position - k
        (red0, blue0), (red1, blue1) = _ILLUMINANTS[k : k + 2]
        red_gain = (red0 + t * (red1 - red0)) * (0.98 + 0.04 * red)
        blue_gain = (blue0 + t * (blue1 - blue0)) * (0.98 + 0.04 * blue)

        if iso is None:
            iso = list(NOISE_LEVELS)[int(level * len(NOISE_LEVELS))]
        return DemoShot(
            white_balance=(red_gain, 1.0, blue_gain),
            exposure=_EXPOSURE[0] + exposure * (_EXPOSURE[1] - _EXPOSURE[0]),
            iso=iso,
            noise_seed=int(torch.randint(2**62, (), generator=generator)),
        )

    def apply(self, picture: Tensor, shot: DemoShot, name: str = "demo") -> Pair:
        """Take the shot with ``picture`` as the scene, uint8 ``(3, H, W)`` with even sides of at least 4."""
        if picture.ndim != 3 or picture.shape[0] != 3 or picture.dtype != torch.uint8 or min(picture.shape[1:]) < 4:
            raise ValueError(f"{name}: a scene must be uint8 (3, H, W), at least 4 x 4, got {tuple(picture.shape)}")
        exposed = self._expose(picture, shot)
        clean = _digitise(exposed)

        shot_var, read_var = NOISE_LEVELS[shot.iso]
        generator = torch.Generator().manual_seed(shot.noise_seed)
        electrons = torch.poisson(exposed / shot_var, generator=generator)
        read_noise = torch.randn(exposed.shape, generator=generator) * read_var**0.5
        frame = RawFrame(
            clean,
            self.cfa,
            white_balance=shot.white_balance,
            color_matrix=torch.tensor(_COLOR_MATRIX),
            camera="rawaug demo camera",
        )
        mosaic = _digitise(shot_var * electrons + read_noise)
        noisy = replace(frame, mosaic=mosaic, noise_profile=(shot_var, read_var))
        return Pair(name, frame, self._render(clean, shot), noisy)

    def capture(self, picture: Tensor, generator: torch.Generator, name: str = "demo", iso: int | None = None) -> Pair:
        """Call :meth:`sample` and :meth:`apply` in one step."""
        return self.apply(picture, self.sample(generator, iso), name)

    def _expose(self, picture: Tensor, shot: DemoShot) -> Tensor:
        """Compute the light on the sensor before noise, ``(1, H, W)``, white = 1."""
        from kornia.filters import gaussian_blur2d

        scene = decode_srgb(picture[None].float() / 255)
        scene = gaussian_blur2d(scene, 5, (_BLUR, _BLUR))[0]

        to_camera = torch.linalg.inv(torch.tensor(_COLOR_MATRIX))
        camera = torch.einsum("ij,jhw->ihw", to_camera, scene) / _column(shot.white_balance)

        light = shot.exposure * _shading(*picture.shape[-2:]) * camera
        return mosaic(light, self.cfa).clamp(min=0)

    def _render(self, raw: Tensor, shot: DemoShot) -> Tensor:
        """Develop a mosaic ``(1, H, W)`` to uint8 ``(3, H, W)``."""
        unshaded = raw / _shading(*raw.shape[-2:])
        camera = demosaic(unshaded[None], self.cfa, "malvar")[0] * _column(shot.white_balance)
        linear = torch.einsum("ij,jhw->ihw", torch.tensor(_COLOR_MATRIX), camera.clamp(0, 1)).clamp(0, 1)
        return (_tone(linear) * 255).round().to(torch.uint8)


def _column(gains: tuple[float, float, float]) -> Tensor:
    return torch.tensor(gains).reshape(3, 1, 1)


def _shading(height: int, width: int) -> Tensor:
    """Relative illumination ``(height, width)``: cos^4 of the angle, 1 at its centre, about 0.6 in the corners."""
    half_diagonal = (height**2 + width**2) ** 0.5 / 2
    y = (torch.arange(height) + 0.5 - height / 2) / half_diagonal - _SHADING_CENTRE[0]
    x = (torch.arange(width) + 0.5 - width / 2) / half_diagonal - _SHADING_CENTRE[1]
    tangent = (y[:, None] ** 2 + x**2) / _SHADING_FOCAL_LENGTH**2
    return (1 + tangent) ** -2


def _digitise(light: Tensor) -> Tensor:
    """Quantise RAW with black 0 and white 1 to the digital numbers of the converter."""
    numbers = (light * (WHITE - BLACK) + BLACK).round().clamp(0, WHITE)
    return (numbers - BLACK) / (WHITE - BLACK)


def _tone(linear: Tensor) -> Tensor:
    """Apply a film-like curve: a highlight shoulder, the sRGB transfer, an S curve; [0, 1] to [0, 1], increasing."""
    display = encode_srgb(linear * (1 + _SHOULDER) / (linear + _SHOULDER))
    return (1 - _CONTRAST) * display + _CONTRAST * display**2 * (3 - 2 * display)


PHOTOGRAPHS = {
    "train": ("astronaut.png", "rocket.jpg"),
    "validation": ("motorcycle_left.png", "motorcycle_right.png"),
    "test": ("coffee.png", "chelsea.png"),
}
"""Files in scikit-image's data folder; the two motorcycles show one scene from two places."""

PICTURES_ONLY = ("brick.png", "grass.png", "gravel.png", "hubble_deep_field.jpg", "ihc.png")
"""More photographs in the user's sRGB folder, of which the camera has no RAW."""

PAIRS = {"train": 5, "validation": 4, "test": 9}
"""Default number of pairs in each split."""

FRAME = (288, 448)
"""Height and width of every frame."""


def demo_photographs(split: str) -> dict[str, Tensor]:
    """The photographs of a split by name, uint8 ``(3, H, W)``; ValueError if there is no such split."""
    require_split("demo", split, PHOTOGRAPHS)
    return dict(_read(PHOTOGRAPHS[split]))


def demo_files() -> list[Path]:
    """The files of all photographs."""
    files: list[Path] = []
    for names in (*PHOTOGRAPHS.values(), PICTURES_ONLY):
        files += [_folder() / name for name in names]
    return files


def demo_pairs(split: str, count: int | None = None) -> list[Pair]:
    """Make shots by the demo camera, 288 x 448, of the split's photographs and, except in training, of dead leaves.

    Pair k depends on (split, k) alone; scenes and ISO values take turns.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        count: number of pairs, by default that of :data:`PAIRS`.

    Raises:
        ValueError: if there is no such split, or ``count`` is not positive.

    Example:
        >>> pair = demo_pairs("train", count=1)[0]
        >>> pair.clean.mosaic.shape, pair.cfa, pair.noisy is not None
        (torch.Size([1, 288, 448]), <CFA.GRBG: 'GRBG'>, True)
    """
    require_split("demo", split, PHOTOGRAPHS)
    if count is None:
        count = PAIRS[split]
    if count < 1:
        raise ValueError(f"demo:{split}: count must be at least 1, got {count}")
    return [_pair(split, k) for k in range(count)]


class PicturesInMemory(Dataset[Tensor], Sequence[Tensor]):
    """Pictures in memory: a sequence that a DataLoader takes."""

    def __init__(self, pictures: Sequence[Tensor]) -> None:
        self.pictures = list(pictures)

    def __len__(self) -> int:
        return len(self.pictures)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice) -> PicturesInMemory: ...
    def __getitem__(self, index: int | slice) -> Tensor | PicturesInMemory:
        if isinstance(index, slice):
            return PicturesInMemory(self.pictures[index])
        return self.pictures[index]


def demo_pictures(count: int = 32) -> PicturesInMemory:
    """Make the sRGB pictures of a user: whole photographs, then dead leaves of 288 x 448 textured from them.

    The photographs are those of the training pairs and five others, and none of validation or test.
    """
    if count < 1:
        raise ValueError(f"demo: count must be at least 1, got {count}")
    pictures = _users_photographs()[:count]
    for k in range(count - len(pictures)):
        pictures.append(_leaves(k))
    return PicturesInMemory(pictures)


@DATASETS.register("demo")
def open_demo(path: str = "", split: str = "test") -> list[Pair]:
    """Open ``demo:SPLIT``, or the ``split`` of ``demo:``."""
    return demo_pairs(path or split)


@PICTURES.register("demo")
def open_demo_pictures(path: str = "", min_side: int = 2) -> PicturesInMemory:
    if path:
        raise ValueError(f"demo:{path}: the demo's pictures have no parts; use demo:")
    return demo_pictures()


def _users_photographs() -> list[Tensor]:
    return [*demo_photographs("train").values(), *_read(PICTURES_ONLY).values()]


@cache
def _leaves(k: int) -> Tensor:
    return dead_leaves(*FRAME, _users_photographs(), keyed_generator(0, "demo pictures", k))


@cache
def _pair(split: str, k: int) -> Pair:
    photographs = demo_photographs(split)
    scenes = list(photographs)
    if split != "train":
        scenes.append("leaves")
    turn, position = divmod(k, len(scenes))
    scene = scenes[position]

    generator = keyed_generator(0, "demo pair", split, k)
    if scene == "leaves":
        picture = dead_leaves(*FRAME, list(photographs.values()), generator)
    else:
        picture = _random_crop(photographs[scene], generator)
    # each scene gets every ISO in turn, and the first few pairs span the range
    isos = list(NOISE_LEVELS)
    iso = isos[(1 + turn + len(isos) // len(scenes) * position) % len(isos)]
    return DemoCamera().capture(picture, generator, name=f"{split}_{k:02d}_{scene}", iso=iso)


def _random_crop(photograph: Tensor, generator: torch.Generator) -> Tensor:
    """Draw a window of :data:`FRAME`, flipped with probability 1/2."""
    height, width = FRAME
    y = int(torch.randint(photograph.shape[-2] - height + 1, (), generator=generator))
    x = int(torch.randint(photograph.shape[-1] - width + 1, (), generator=generator))
    crop = photograph[:, y : y + height, x : x + width]
    if torch.rand((), generator=generator) < 0.5:
        crop = crop.flip(-1)
    return crop


@cache
def _read(files: tuple[str, ...]) -> dict[str, Tensor]:
    pictures = {}
    for file in files:
        pictures[Path(file).stem] = read_picture(_folder() / file)
    return pictures


def _folder() -> Path:
    with extra("train"):
        import skimage

    return Path(skimage.__file__).parent / "data"
