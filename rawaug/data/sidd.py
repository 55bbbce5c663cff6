"""SIDD: full frames of five phones, noisy and clean, with their pictures.

docs/datasets.md shows the files. RAW frames have black at 0 and white at 1, and the makers clipped them at black.
Pictures of frames are upright, and METADATA say how to turn them back. The validation blocks are read by
:mod:`rawaug.data.sidd_blocks`, the benchmark by :mod:`rawaug.data.sidd_benchmark`. Source: A. Abdelhamed, S. Lin, M. S.
Brown, "A high-quality denoising dataset for smartphone cameras", CVPR 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from rawaug.bayer import turn_back
from rawaug.data.development import develop_pair
from rawaug.data.frames import Frames
from rawaug.data.noise_levels import measure_levels
from rawaug.data.pairs import DATASETS, Pair
from rawaug.data.sidd_blocks import SiddBlocks
from rawaug.data.sidd_scenes import (
    HELD_BACK,
    even,
    find_phone,
    index_files,
    noise_level_functions,
    parse_label,
    read_sidd_colour,
    read_sidd_mosaic,
)
from rawaug.io import RawFrame, read_picture


class SiddFrames(Frames[Pair]):
    """The full frames below a folder: SIDD Small or Medium in RAW, with the sRGB set if it is there.

    Noise levels come from ``noise_level_functions.csv``, or are measured against the clean frame if that file is
    missing (``levels_from_clean``). Without its ``GT_SRGB`` picture, a clean frame is developed as the makers of the
    dataset did. A ``NOISY_SRGB`` picture is read if there is one. Scene instances in ``left_out`` are excluded.
    """

    def __init__(self, path: str | Path, left_out: Sequence[str] = HELD_BACK) -> None:
        self.path = Path(path)
        self.shots = _shots_below(self.path, left_out)
        if not self.shots:
            raise ValueError(f"{path}: contains no NOISY_RAW training frames of SIDD")

        self.levels = noise_level_functions(self.path)
        self.labels = [parse_label(scene) for scene, _, _ in self.shots]
        super().__init__([f"{scene}_{number}" for scene, number, _ in self.shots])

    def read(self, index: int) -> Pair:
        scene, _, files = self.shots[index]
        clean = read_sidd_mosaic(files["GT_RAW"])
        noisy = read_sidd_mosaic(files["NOISY_RAW"])
        if clean.shape != noisy.shape:
            sizes = f"{tuple(clean.shape[1:])} and {tuple(noisy.shape[1:])}"
            raise ValueError(f"{files['NOISY_RAW']}: the clean and the noisy frame differ in size, {sizes}")

        gains, matrix, view = read_sidd_colour(files["METADATA_RAW"])
        pictures = {}
        for key, kind in (("srgb", "GT_SRGB"), ("noisy_srgb", "NOISY_SRGB")):
            if kind in files:
                pictures[key] = _turned_back(files[kind], view, self.max_pixels)

        camera, cfa = find_phone(scene)
        frame = RawFrame(clean, cfa, white_balance=gains, color_matrix=matrix, camera=camera)
        published = self.levels.get(scene)
        levels = published or measure_levels(clean, noisy)
        capture = replace(frame, mosaic=noisy, noise_profile=levels)
        return develop_pair(self.names[index], frame, capture, levels_from_clean=published is None, **pictures)


def _shots_below(path: Path, left_out: Sequence[str]) -> list[tuple[str, str, dict[str, Path]]]:
    """List scene instance, number and files (by kind) of each noisy frame below ``path``, in order."""
    shots = []
    for (scene, number), files in sorted(index_files(path).items()):
        if "NOISY_RAW" not in files or scene in left_out:
            continue
        missing = {"GT_RAW", "METADATA_RAW"} - set(files)
        if missing:
            raise ValueError(f"{files['NOISY_RAW']}: its {min(missing)}_{number} is missing; download it too")
        shots.append((scene, number, files))
    return shots


def _turned_back(file: Path, view: int, max_pixels: int) -> Tensor:
    """Read the upright picture in ``file`` and turn it to the orientation of the sensor."""
    picture = read_picture(file, max_pixels)
    return even(turn_back(picture, view)).contiguous()


@DATASETS.register("sidd")
def sidd_pairs(path: str, split: str) -> Sequence[Pair]:
    """Open the full frames (``train``) or the validation blocks (``test``)."""
    if split == "train":
        return SiddFrames(path)
    if split == "test":
        return SiddBlocks(path)
    raise ValueError(
        f"sidd:{path}: no split {split}; use train (full frames) or test (validation blocks), "
        "and another folder, or null, for validation"
    )


@DATASETS.register("sidd-cc")
def sidd_cc_pairs(path: str, split: str) -> Sequence[Pair]:
    """Open the full frames of SIDD-CC's own ``train``, in the layout of SIDD Medium, with clean RAW estimated anew.
    Source: <https://huggingface.co/datasets/MhdMohammadi/SIDD-CC>.
    """
    if split != "train":
        raise ValueError(f"sidd-cc:{path}: no split {split}; use train; its test blocks are not read")
    return SiddFrames(path, left_out=())
