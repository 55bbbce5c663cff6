"""SIDD: full frames of five phones, noisy and clean, with their pictures; blocks of 256 x 256; and the blocks of SIDD+.

docs/datasets.md shows the files. RAW frames and blocks have black at 0 and white at 1, and the makers clipped them at
black. METADATA files hold the tags of the DNG. The phone determines the pattern (the dataset's ``bayer_patterns.csv``);
:data:`HELD_BACK` lists the scene instance of each block, which names its phone. Pictures of frames are upright, and
METADATA say how to turn them back. Pictures of blocks do not say how they were turned, so the blocks of a frame are
turned to the one of eight views in which their green correlates best with the green of the mosaics. Blocks without
pictures and METADATA have gains of 1 and show camera colour (``rendered`` is False). They can test a denoiser, but not
an ISP.

Source: A. Abdelhamed, S. Lin, M. S. Brown, "A high-quality denoising dataset for smartphone cameras", CVPR 2018, and
the dataset's ``noise_level_functions.csv``; SIDD+: NTIRE 2020.

The clean blocks of its benchmark are not public. A submission is a CSV with the columns ID (0 to 1279, block by block,
frame by frame) and BLOCK (the bytes of the float32 block, row by row, in base64). Source: the example code of the
dataset's first author, ``sidd_kaggle_submit``.
"""

from __future__ import annotations

import base64
import csv
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA, turn_back
from rawaug.data.development import UNKNOWN_COLOUR, develop_pair, gains_from_neutral, srgb_from_camera
from rawaug.data.formats import read_array, read_value, to_raw
from rawaug.data.noise_levels import measure_levels, measure_noise
from rawaug.data.pairs import DATASETS, FrameLabel, Lazy, LazyPairs, Pair
from rawaug.files import files_below, require_file
from rawaug.io import RawFrame, read_picture
from rawaug.io.pictures import view_of_orientation

T = TypeVar("T")

PHONES = {
    "GP": ("Google Pixel", CFA.BGGR),
    "IP": ("Apple iPhone 7", CFA.RGGB),
    "S6": ("Samsung Galaxy S6 Edge", CFA.GRBG),
    "N6": ("Motorola Nexus 6", CFA.BGGR),
    "G4": ("LG G4", CFA.BGGR),
}
"""Name of each phone and the pattern of its frames, by the code in the names of folders."""

_NAME = re.compile(r"\d{4}_(\d{3})_([A-Z0-9]{2})_(\d{5})_\d{5}_\d{4}_[LNH]")


def label_of(name: str) -> FrameLabel:
    """Parse scene, phone and ISO from the name of a scene instance, which is the name of its folder."""
    match = _NAME.fullmatch(name)
    if match is None or match[2] not in PHONES:
        raise ValueError(f"{name}: is not a SIDD scene instance such as 0052_002_S6_01600_01000_5500_N")

    scene, phone, iso = match.groups()
    return FrameLabel(scene, phone, int(iso))


def phone_of(name: str) -> tuple[str, CFA]:
    """The phone of a scene instance, and the pattern of its frames."""
    return PHONES[label_of(name).phone]


def is_scene(name: str) -> bool:
    return _NAME.fullmatch(name) is not None


HELD_BACK = tuple(Path(__file__).with_name("sidd.txt").read_text(encoding="ascii").split())
"""The scene instances of the validation and benchmark blocks, in their order; training frames have others."""

_FILE = re.compile(r"(?:\d{4}_)?(GT_RAW|NOISY_RAW|METADATA_RAW|GT_SRGB|NOISY_SRGB)_(\d{3})\.(?:mat|png)", re.IGNORECASE)


class SiddFrames(LazyPairs):
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
        self.labels = [label_of(scene) for scene, _, _ in self.shots]
        super().__init__([f"{scene}_{number}" for scene, number, _ in self.shots])

    def read(self, index: int) -> Pair:
        scene, _, files = self.shots[index]
        clean = mosaic_of(files["GT_RAW"])
        noisy = mosaic_of(files["NOISY_RAW"])
        if clean.shape != noisy.shape:
            sizes = f"{tuple(clean.shape[1:])} and {tuple(noisy.shape[1:])}"
            raise ValueError(f"{files['NOISY_RAW']}: the clean and the noisy frame differ in size, {sizes}")

        gains, matrix, view = colour_of(files["METADATA_RAW"])
        pictures = {}
        for key, kind in (("srgb", "GT_SRGB"), ("noisy_srgb", "NOISY_SRGB")):
            if kind in files:
                pictures[key] = _turned_back(files[kind], view, self.max_pixels)

        published = self.levels.get(scene)
        shot_var, read_var = published or measure_levels(clean, noisy)
        camera, cfa = phone_of(scene)
        return develop_pair(
            self.names[index],
            clean,
            cfa,
            gains,
            matrix,
            noisy=noisy,
            shot_var=shot_var,
            read_var=read_var,
            levels_from_clean=published is None,
            camera=camera,
            **pictures,
        )


def _shots_below(path: Path, left_out: Sequence[str]) -> list[tuple[str, str, dict[str, Path]]]:
    """Scene instance, number and files (by kind) of each noisy frame below ``path``, in order."""
    shots = []
    for (scene, number), files in sorted(index_files(path).items()):
        if "NOISY_RAW" not in files or scene in left_out:
            continue
        missing = {"GT_RAW", "METADATA_RAW"} - set(files)
        if missing:
            raise ValueError(f"{files['NOISY_RAW']}: its {min(missing)}_{number} is missing; download it too")
        shots.append((scene, number, files))
    return shots


def mosaic_of(file: Path) -> Tensor:
    """The mosaic ``x`` of a frame, float32 ``(1, H, W)``; an odd side loses its last line."""
    return _even(to_raw(read_array(file, "x"), 2, file))


def noise_level_functions(path: Path) -> dict[str, tuple[float, float]]:
    """(shot_var, read_var) by scene instance, the mean over a mosaic's sites; empty without the CSV below ``path``."""
    file = min(files_below(path, ("noise_level_functions.csv",)), default=None)
    if file is None:
        return {}

    require_file(file)
    with file.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream, skipinitialspace=True))

    levels = {}
    for row in rows:
        try:
            shot_var = _mean_over_sites(row, "beta1")
            read_var = _mean_over_sites(row, "beta2")
            levels[row["scene_instance_id"]] = (max(shot_var, 0.0), max(read_var, 0.0))
        except (KeyError, TypeError, ValueError) as error:
            columns = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
            raise ValueError(f"{file}: each row has the columns {columns}; {error!r} is wrong") from error
    return levels


def _mean_over_sites(row: dict[str, str], parameter: str) -> float:
    """The mean of a noise parameter over the sites R, G, G, B."""
    return sum(float(row[f"{parameter}_{colour}"]) for colour in "rggb") / 4


def index_files(path: Path) -> dict[tuple[str, str], dict[str, Path]]:
    """Files below ``path`` by (scene instance, number), and by kind: GT_RAW, NOISY_RAW, METADATA_RAW, GT_SRGB,
    NOISY_SRGB."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of SIDD")

    index: dict[tuple[str, str], dict[str, Path]] = {}
    for file in files_below(path):
        scene = file.parent.name
        match = _FILE.fullmatch(file.name)
        if match is not None and is_scene(scene):
            kind, number = match[1].upper(), match[2]
            index.setdefault((scene, number), {})[kind] = file
    return index


class Colour(NamedTuple):
    """Gains, colour matrix and upright view from a METADATA file."""

    white_balance: tuple[float, float, float]
    matrix: Tensor
    upright_view: int


def colour_of(file: Path) -> Colour:
    tags: dict[str, Any] = read_value(file, "metadata")
    try:
        gains = gains_from_neutral(tags["AsShotNeutral"])
        matrix = srgb_from_camera(tags["ColorMatrix2"])
        view = view_of_orientation(int(tags.get("Orientation", 1)))
        return Colour(gains, matrix, view)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{file}: has no valid AsShotNeutral and ColorMatrix2 ({error}); download it again") from error


def _turned_back(file: Path, view: int, max_pixels: int) -> Tensor:
    """The upright picture in ``file``, turned to the orientation of the sensor."""
    picture = read_picture(file, max_pixels)
    return _even(turn_back(picture, view)).contiguous()


def _even(image: Tensor) -> Tensor:
    height = image.shape[-2] // 2 * 2
    width = image.shape[-1] // 2 * 2
    return image[..., :height, :width]


LEAST_LIKENESS = 0.8
"""Minimum correlation between the greens of the pictures and of the mosaics of a frame's blocks."""


def turn_like(pictures: Tensor, mosaics: Tensor, cfa: CFA, what: str) -> Tensor:
    """Turn the pictures ``(K, 3, H, W)`` of a frame's blocks to the view of their mosaics ``(K, 1, H, W)``."""
    planes = bayer.pack(mosaics, cfa)
    raw_green = (planes[:, 1] + planes[:, 2]).clamp_min(0.0).sqrt()
    green = F.avg_pool2d(pictures[:, 1:2].float(), 2)[:, 0]

    n_views = bayer.N_VIEWS
    is_square = pictures.shape[-2] == pictures.shape[-1]
    if not is_square:  # quarter turns would change the shape
        n_views //= 2

    likeness = torch.stack([_correlation(bayer.turn_back(green, view), raw_green) for view in range(n_views)])
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS:
        raise ValueError(f"{what}: its pictures do not show its RAW blocks (correlation {likeness[best]:.2f})")
    return bayer.turn_back(pictures, best).contiguous()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Correlation of two stacks of images; 1 if one of them is flat."""
    value = torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1]
    return torch.where(value.isfinite(), value, torch.ones(()))


BLOCKS = 32
"""Number of blocks of a frame."""

_NO_COLOUR = Colour(*UNKNOWN_COLOUR, 0)


class Once(Generic[T]):
    """A function that calls ``read`` once, and returns its value or raises its error on every call."""

    def __init__(self, read: Callable[[], T]) -> None:
        self.read = read
        self._outcome: T | Exception | None = None

    def __call__(self) -> T:
        if self._outcome is None:
            try:
                self._outcome = self.read()
            except (OSError, ValueError) as error:
                self._outcome = error

        if isinstance(self._outcome, Exception):
            raise self._outcome.with_traceback(None)
        return self._outcome


class _Frame(NamedTuple):
    """A frame of blocks: its name, phone and pattern, and its published noise levels and colour if there are any."""

    name: str
    camera: str
    cfa: CFA
    levels: tuple[float, float] | None = None
    colour: Colour | None = None


class _Blocks(LazyPairs):
    """Blocks that are all read on the first access; what the blocks of a frame share is cached for the last frame."""

    def __init__(self, path: Path, frames: Sequence[str]) -> None:
        self.path = path
        self._all = Once(self._read_all)
        self._last_frame: tuple[int, dict[str, Tensor], dict[str, Any]] | None = None
        super().__init__(_block_names(frames))

    @abstractmethod
    def _read_all(self) -> dict[str, Tensor]:
        """``raw``, ``noisy`` and, if there are pictures, ``srgb`` and ``noisy_srgb``, ``(frames, 32, C, H, W)``."""

    @abstractmethod
    def _describe(self, number: int) -> _Frame:
        """Describe the frame with this number."""

    def read(self, index: int) -> Pair:
        number, block = divmod(index, BLOCKS)
        if self._last_frame is None or self._last_frame[0] != number:
            images, attributes = self._read_frame(number)
            self._last_frame = (number, images, attributes)

        _, images, attributes = self._last_frame
        blocks: dict[str, Any] = {}
        for key, stack in images.items():
            blocks[key] = stack[block]
        return develop_pair(self.names[index], **blocks, **attributes)

    def _read_frame(self, number: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The images of a frame's blocks, turned alike, and the other attributes of a :class:`Pair` that they share."""
        everything = self._all()
        frame = self._describe(number)

        images = {}
        for key, stack in everything.items():
            images[key] = stack[number]
        for key in ("srgb", "noisy_srgb"):
            if key in images:
                images[key] = turn_like(images[key], images["raw"], frame.cfa, f"{self.path}: {frame.name}")

        shot_var, read_var = frame.levels or measure_noise(images["raw"].numpy(), images["noisy"].numpy())
        colour = frame.colour or _NO_COLOUR
        attributes = {
            "cfa": frame.cfa,
            "camera": frame.camera,
            "white_balance": colour.white_balance,
            "color_matrix": colour.matrix,
            "shot_var": shot_var,
            "read_var": read_var,
            "levels_from_clean": frame.levels is None,
            "color_known": frame.colour is not None,
            "rendered": "srgb" in images or frame.colour is not None,
        }
        return images, attributes


def _block_names(frames: Sequence[str]) -> list[str]:
    names = []
    for frame in frames:
        names += [f"{frame}_{block:02d}" for block in range(BLOCKS)]
    return names


class SiddBlocks(_Blocks):
    """The validation blocks, 1,280 pairs; all stay in memory (0.7 GB, pictures 0.5 GB) once the first is read.

    Noise levels come from a ``noise_level_functions.csv`` below the folder that lists the scene instance. Otherwise
    they are measured on the 32 blocks of a frame against the clean blocks.
    """

    def __init__(self, path: str | Path) -> None:
        self.clean_file = find_file(Path(path), "ValidationGtBlocksRaw.mat")
        self.noisy_file = find_file(Path(path), "ValidationNoisyBlocksRaw.mat")
        super().__init__(Path(path), HELD_BACK)

    def _describe(self, number: int) -> _Frame:
        name = HELD_BACK[number]
        camera, cfa = phone_of(name)
        return _Frame(name, camera, cfa, self._levels.get(name), self._colours.get(name))

    def _read_all(self) -> dict[str, Tensor]:
        clean = blocks_of_scenes(self.clean_file)
        noisy = blocks_of_scenes(self.noisy_file)
        _require_same_shape(clean, noisy, self.noisy_file)

        self._levels = noise_level_functions(self.path)
        self._colours = _colours(self.path)
        pictures = _pictures(self.path, "Validation{}BlocksSrgb.mat", ("Gt", "Noisy"), clean)
        return {"raw": clean, "noisy": noisy, **pictures}


class SiddBenchmark(Lazy[RawFrame]):
    """The noisy blocks of ``BenchmarkNoisyBlocksRaw.mat`` below a folder, with their noise levels if published.

    Pass the results to :func:`write_submission` in the same order.
    """

    def __init__(self, path: str | Path) -> None:
        file = find_file(Path(path), "BenchmarkNoisyBlocksRaw.mat")
        self.levels = noise_level_functions(Path(path))
        self._all = Once(partial(blocks_of_scenes, file))
        super().__init__(_block_names(HELD_BACK))

    def read(self, index: int) -> RawFrame:
        number, block = divmod(index, BLOCKS)
        scene = HELD_BACK[number]
        _, cfa = phone_of(scene)
        return RawFrame(
            self._all()[number, block],
            cfa,
            noise_profile=self.levels.get(scene),
            name=self.names[index],
            color_known=False,
        )


def write_submission(path: str | Path, blocks: Iterable[Tensor], side: int = 256) -> None:
    """Write 1,280 denoised mosaics ``(1, side, side)`` in [0, 1], in the order and patterns of :class:`SiddBenchmark`.

    Raises:
        ValueError: if ``path`` is not a .csv file, or the server would refuse the blocks.
    """
    path = Path(path)
    if path.suffix != ".csv":
        raise ValueError(f"{path}: a SIDD submission must be a .csv file")
    rows = []
    for number, block in enumerate(blocks):
        in_range = bool(block.numel()) and bool(block.min() >= 0.0 and block.max() <= 1.0)  # False for NaN, too
        if block.shape != (1, side, side) or not in_range:
            raise ValueError(
                f"block {number}: must have values in [0, 1] and shape (1, {side}, {side}): {tuple(block.shape)}"
            )
        content = block[0].cpu().numpy().astype("<f4").tobytes()
        rows.append((number, base64.b64encode(content).decode()))

    if len(rows) != len(HELD_BACK) * BLOCKS:
        raise ValueError(f"{path}: a submission must have {len(HELD_BACK) * BLOCKS} blocks, got {len(rows)}")

    with path.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["ID", "BLOCK"])
        table.writerows(rows)


@DATASETS.register("siddplus")
class SiddPlusBlocks(_Blocks):
    """The validation blocks of SIDD+, 1,024 pairs, for any split; noise is measured as for :class:`SiddBlocks`."""

    def __init__(self, path: str | Path, split: str = "test") -> None:
        self.clean_file = find_file(Path(path), "siddplus_valid_gt_raw.mat")
        self.noisy_file = find_file(Path(path), "siddplus_valid_noisy_raw.mat")
        self.cfas = _patterns(find_file(Path(path), "siddplus_*bayer_patterns.csv"))
        super().__init__(Path(path), [f"siddplus_{number:02d}" for number in range(len(self.cfas))])

    def _describe(self, number: int) -> _Frame:
        return _Frame(f"frame {number}", "SIDD+", self.cfas[number])

    def _read_all(self) -> dict[str, Tensor]:
        clean = to_raw(read_array(self.clean_file, self.clean_file.stem), 3, self.clean_file)
        noisy = to_raw(read_array(self.noisy_file, self.noisy_file.stem), 3, self.noisy_file)
        _require_same_shape(clean, noisy, self.noisy_file)
        if len(clean) != len(self):
            raise ValueError(f"{self.clean_file}: has {len(clean)} blocks, but there are patterns for {len(self)}")

        images = {"raw": clean, "noisy": noisy}
        images |= _pictures(self.path, "siddplus_valid_{}_srgb.mat", ("gt", "noisy"), clean)
        for key, stack in images.items():
            images[key] = stack.unflatten(0, (-1, BLOCKS))
        return images


@DATASETS.register("sidd")
def sidd_pairs(path: str, split: str) -> Sequence[Pair]:
    """The full frames (``train``) or the validation blocks (``test``)."""
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
    """The full frames of SIDD-CC's own ``train``, in the layout of SIDD Medium, their clean RAW estimated anew.

    Source: <https://huggingface.co/datasets/MhdMohammadi/SIDD-CC>.
    """
    if split != "train":
        raise ValueError(f"sidd-cc:{path}: no split {split}; use train; its test blocks are not read")
    return SiddFrames(path, left_out=())


def find_file(path: Path, pattern: str) -> Path:
    """The one file of this name below ``path``, or ``path`` itself."""
    if path.is_file() and path.match(pattern):
        return path

    matches = _matching(path, pattern)
    if not matches:
        raise FileNotFoundError(f"{path}: contains no {pattern}; docs/datasets.md says where to get it")
    if len(matches) > 1:
        example = f"such as {matches[0]}"
        raise ValueError(f"{path}: contains {len(matches)} files {pattern}, {example}; give a folder with one")
    return matches[0]


def _matching(folder: Path, pattern: str) -> list[Path]:
    return sorted(file for file in files_below(folder) if fnmatchcase(file.name, pattern))


def _pictures(path: Path, pattern: str, kinds: tuple[str, str], clean: Tensor) -> dict[str, Tensor]:
    """The uint8 pictures of the clean and noisy blocks, with the axes of ``clean``, as far as their files exist."""
    expected = (*clean.shape[:-3], *clean.shape[-2:], 3)
    pictures = {}
    for key, kind in zip(("srgb", "noisy_srgb"), kinds, strict=True):
        name = pattern.format(kind)
        if not _matching(path, name):
            continue

        file = find_file(path, name)
        array = read_array(file, file.stem)
        if array.dtype.name != "uint8" or array.shape != expected:
            raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the mosaics need uint8 {expected}")
        pictures[key] = torch.from_numpy(array).movedim(-1, -3)
    return pictures


def _patterns(file: Path) -> list[CFA]:
    """The patterns in the first column of a CSV file, one for each frame."""
    require_file(file)
    patterns = []
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            for row in csv.reader(stream):
                if row:
                    patterns.append(CFA(row[0].strip().upper()))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{file}: is not a list of patterns, one for each frame ({error}); copy it again") from None
    return patterns


def blocks_of_scenes(file: Path) -> Tensor:
    """The blocks in a file, ``(40, 32, 1, H, W)``."""
    blocks = to_raw(read_array(file, file.stem), 4, file)
    if blocks.shape[:2] != (len(HELD_BACK), BLOCKS):
        raise ValueError(f"{file}: holds {tuple(blocks.shape[:2])} blocks, the published file {len(HELD_BACK), BLOCKS}")
    return blocks


def _colours(path: Path) -> dict[str, Colour]:
    """The colour of each scene instance of the blocks that has a METADATA file below ``path``."""
    files = {}
    for (scene, _), files_of_frame in index_files(path).items():
        if scene in HELD_BACK and "METADATA_RAW" in files_of_frame:
            files[scene] = files_of_frame["METADATA_RAW"]

    colours = {}
    for scene, file in files.items():
        colours[scene] = colour_of(file)
    return colours


def _require_same_shape(clean: Tensor, noisy: Tensor, file: Path) -> None:
    if clean.shape != noisy.shape:
        raise ValueError(f"{file}: holds {tuple(noisy.shape)}, its clean counterpart {tuple(clean.shape)}")
