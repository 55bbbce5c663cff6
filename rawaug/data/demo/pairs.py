"""Built-in data: a few photographs, dead leaves textured from them, and shots of both by the demo camera.

The photographs are files of scikit-image's wheel; nothing is downloaded. The splits share no photograph and no source
of texture. As in practice, there are few RAW pairs and many sRGB pictures.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from rawaug.data.demo.camera import NOISE_LEVELS, DemoCamera
from rawaug.data.demo.drawn import dead_leaves
from rawaug.data.pairs import Pair, require_split
from rawaug.errors import extra
from rawaug.io import read_picture
from rawaug.registry import DATASETS, PICTURES
from rawaug.seeding import keyed_generator

PHOTOGRAPHS = {
    "train": ("astronaut.png", "rocket.jpg"),
    "validation": ("motorcycle_left.png", "motorcycle_right.png"),
    "test": ("coffee.png", "chelsea.png"),
}
"""Files in scikit-image's data folder; the two motorcycles are one scene from two places."""

PICTURES_ONLY = ("brick.png", "grass.png", "gravel.png", "hubble_deep_field.jpg", "ihc.png")
"""More photographs of the user's sRGB folder, of which the camera has no RAW."""

PAIRS = {"train": 5, "validation": 4, "test": 9}
"""Default number of pairs of a split."""

FRAME = (288, 448)
"""Height and width of every frame."""


def demo_photographs(split: str) -> dict[str, Tensor]:
    """The split's photographs by name, uint8 ``(3, H, W)``.

    Raises:
        ValueError: if there is no such split.
        FileNotFoundError: if scikit-image's installation lacks them.
    """
    require_split("demo", split, PHOTOGRAPHS)
    return dict(_read(PHOTOGRAPHS[split]))


def demo_files() -> list[Path]:
    """The files of all photographs."""
    return [_folder() / file for files in (*PHOTOGRAPHS.values(), PICTURES_ONLY) for file in files]


def demo_pairs(split: str, count: int | None = None, seed: int = 0) -> list[Pair]:
    """Shots by the demo camera, 288 x 448: crops of the split's photographs, and of dead leaves except in training.

    Pair k depends on (split, k, seed) alone; scenes and ISO values take turns.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        count: number of pairs, by default that of :data:`PAIRS`.
        seed: another seed gives other crops, illuminants and noise, of the same photographs.

    Raises:
        ValueError: if there is no such split, or ``count`` is not positive.

    Example:
        >>> pair = demo_pairs("train", count=1)[0]
        >>> pair.raw.shape, pair.cfa, pair.noisy is not None
        (torch.Size([1, 288, 448]), <CFA.GRBG: 'GRBG'>, True)
    """
    require_split("demo", split, PHOTOGRAPHS)
    count = PAIRS[split] if count is None else count
    if count < 1:
        raise ValueError(f"demo:{split}: count must be at least 1, got {count}")
    return [_pair(split, k, seed) for k in range(count)]


def demo_pictures(count: int = 32, seed: int = 0) -> list[Tensor]:
    """The sRGB pictures of a user: photographs whole, then dead leaves of 288 x 448 textured from them.

    The photographs are those of the training pairs and five others, none of validation or test.

    Raises:
        ValueError: if ``count`` is not positive.
    """
    if count < 1:
        raise ValueError(f"demo: count must be at least 1, got {count}")
    photographs = _users_photographs()
    leaves = (_leaves(k, seed) for k in range(count - len(photographs)))
    return [*photographs[:count], *leaves]


@DATASETS.register("demo")
def open_demo(path: str = "", split: str = "test") -> list[Pair]:
    """``demo:SPLIT``, or ``demo:`` and the split that is asked for."""
    return demo_pairs(path or split)


@PICTURES.register("demo")
def open_demo_pictures(path: str = "", min_side: int = 2) -> list[Tensor]:
    """``demo:``, all of them."""
    if path:
        raise ValueError(f"demo:{path}: the demo's pictures have no parts; use demo:")
    return demo_pictures()


def _users_photographs() -> list[Tensor]:
    return [*demo_photographs("train").values(), *_read(PICTURES_ONLY).values()]


@cache
def _leaves(k: int, seed: int) -> Tensor:
    return dead_leaves(*FRAME, _users_photographs(), keyed_generator(seed, "demo pictures", k))


@cache
def _pair(split: str, k: int, seed: int) -> Pair:
    photographs = demo_photographs(split)
    scenes = list(photographs) if split == "train" else [*photographs, "leaves"]
    scene, turn = scenes[k % len(scenes)], k // len(scenes)
    generator = keyed_generator(seed, "demo pair", split, k)
    if scene == "leaves":
        picture = dead_leaves(*FRAME, list(photographs.values()), generator)
    else:
        picture = _random_crop(photographs[scene], generator)
    levels = list(NOISE_LEVELS)
    # every scene meets every ISO in time, and a few pairs already span the range
    iso = levels[(1 + turn + len(levels) // len(scenes) * (k % len(scenes))) % len(levels)]
    return DemoCamera().capture(picture, generator, name=f"{split}_{k:02d}_{scene}", iso=iso)


def _random_crop(photograph: Tensor, generator: torch.Generator) -> Tensor:
    top, left = (
        int(torch.randint(side - size + 1, (), generator=generator))
        for side, size in zip(photograph.shape[-2:], FRAME, strict=True)
    )
    crop = photograph[:, top : top + FRAME[0], left : left + FRAME[1]]
    return crop.flip(-1) if torch.rand((), generator=generator) < 0.5 else crop


@cache
def _read(files: tuple[str, ...]) -> dict[str, Tensor]:
    return {Path(file).stem: read_picture(_folder() / file) for file in files}


def _folder() -> Path:
    with extra("train"):
        import skimage

    return Path(skimage.__file__).parent / "data"
