"""SIDD: full frames of five phones, noisy and clean, with their pictures; blocks of 256 x 256; and the blocks of SIDD+.

docs/datasets.md shows the files. RAW frames and blocks have white at 1, are black-subtracted and, by their makers,
clipped at black; METADATA hold the DNG's tags. The pattern goes by phone (the dataset's ``bayer_patterns.csv``), that
of a block by the phone of its scene instance in :data:`HELD_BACK`. Pictures of frames are upright and turned back by
METADATA; those of blocks do not say how they were turned: a frame's blocks take that of the eight turns in which their
green agrees best with the green of the mosaics. Blocks without pictures and METADATA have gains of 1 and show camera
colour (``rendered`` is False): they can test a denoiser, but no ISP.

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
from rawaug.data.pairs import DATASETS, FrameLabel, Lazy, LazyPairs, Pair, measure_levels, measure_noise
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
"""The phone and the pattern of its frames, by the code in the folder's name."""

_NAME = re.compile(r"\d{4}_(\d{3})_([A-Z0-9]{2})_(\d{5})_\d{5}_\d{4}_[LNH]")


def label_of(name: str) -> FrameLabel:
    """Read scene, phone and ISO from the name of a scene instance, which is that of its folder."""
    found = _NAME.fullmatch(name)
    if found is None or found[2] not in PHONES:
        raise ValueError(f"{name}: is not a SIDD scene instance such as 0052_002_S6_01600_01000_5500_N")
    return FrameLabel(found[1], found[2], int(found[3]))


def phone_of(name: str) -> tuple[str, CFA]:
    """The phone of a scene instance, and the pattern of its frames."""
    return PHONES[label_of(name).phone]


def is_scene(name: str) -> bool:
    return _NAME.fullmatch(name) is not None


HELD_BACK = tuple(Path(__file__).with_name("sidd.txt").read_text(encoding="ascii").split())
"""The scene instances of the blocks of validation and benchmark, in their order; none is among those for training."""

_FILE = re.compile(r"(?:\d{4}_)?(GT_RAW|NOISY_RAW|METADATA_RAW|GT_SRGB|NOISY_SRGB)_(\d{3})\.(?:mat|png)", re.IGNORECASE)


class SiddFrames(LazyPairs):
    """The full frames below a folder: SIDD Small or Medium, RAW, and the sRGB set if present.

    Noise levels are those of a ``noise_level_functions.csv`` where there is one, else measured against the clean frame,
    which the pair says (``levels_from_clean``). Where a frame's ``GT_SRGB`` picture is not there, the clean frame is
    developed as the dataset's makers did; its ``NOISY_SRGB`` picture is read where there is one. Scene instances in
    ``left_out`` are not taken.
    """

    def __init__(self, path: str | Path, left_out: Sequence[str] = HELD_BACK) -> None:
        self.path = Path(path)
        self.shots = [
            (scene, number, files)
            for (scene, number), files in sorted(index_files(self.path).items())
            if "NOISY_RAW" in files and scene not in left_out
        ]
        for _, number, files in self.shots:
            missing = {"GT_RAW", "METADATA_RAW"} - set(files)
            if missing:
                raise ValueError(f"{files['NOISY_RAW']}: its {min(missing)}_{number} is missing; download it too")
        if not self.shots:
            raise ValueError(f"{path}: contains no NOISY_RAW training frames of SIDD")
        self.levels = noise_level_functions(self.path)
        self.labels = [label_of(scene) for scene, *_ in self.shots]
        super().__init__([f"{scene}_{number}" for scene, number, _ in self.shots])

    def read(self, index: int) -> Pair:
        scene, _, files = self.shots[index]
        clean, noisy = (mosaic_of(files[kind]) for kind in ("GT_RAW", "NOISY_RAW"))
        if clean.shape != noisy.shape:
            sizes = f"{tuple(clean.shape[1:])} and {tuple(noisy.shape[1:])}"
            raise ValueError(f"{files['NOISY_RAW']}: the clean and the noisy frame differ in size, {sizes}")
        gains, matrix, view = colour_of(files["METADATA_RAW"])
        (camera, cfa), published = phone_of(scene), self.levels.get(scene)
        shot_var, read_var = published or measure_levels(clean, noisy)
        known: dict[str, Any] = {"noisy": noisy, "shot_var": shot_var, "read_var": read_var, "camera": camera}
        for key, kind in (("srgb", "GT_SRGB"), ("noisy_srgb", "NOISY_SRGB")):
            if kind in files:
                known[key] = _turned_back(files[kind], view, self.max_pixels)
        known["levels_from_clean"] = published is None
        return develop_pair(self.names[index], clean, cfa, gains, matrix, **known)


def mosaic_of(file: Path) -> Tensor:
    """The mosaic ``x`` of a frame, float32 ``(1, H, W)``; of an odd side the last line is left out."""
    return _even(to_raw(read_array(file, "x"), 2, file))


def noise_level_functions(path: Path) -> dict[str, tuple[float, float]]:
    """(shot_var, read_var) by scene instance, the mean over a mosaic's sites, from the CSV below ``path``, if any."""
    file = min(files_below(path, ("noise_level_functions.csv",)), default=None)
    if file is None:
        return {}
    require_file(file)
    with file.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream, skipinitialspace=True))
    levels = {}
    for row in rows:
        try:
            shot, read = (sum(float(row[f"beta{k}_{colour}"]) for colour in "rggb") / 4 for k in (1, 2))
            levels[row["scene_instance_id"]] = max(shot, 0.0), max(read, 0.0)
        except (KeyError, TypeError, ValueError) as error:
            columns = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
            raise ValueError(f"{file}: each row has the columns {columns}; {error!r} is wrong") from error
    return levels


def index_files(path: Path) -> dict[tuple[str, str], dict[str, Path]]:
    """Files below ``path`` by (scene instance, number), and by kind: GT_RAW, NOISY_RAW, METADATA_RAW, GT_SRGB,
    NOISY_SRGB."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of SIDD")
    index: dict[tuple[str, str], dict[str, Path]] = {}
    for file in files_below(path):
        scene = file.parent.name
        if is_scene(scene) and (found := _FILE.fullmatch(file.name)):
            index.setdefault((scene, found[2]), {})[found[1].upper()] = file
    return index


class Colour(NamedTuple):
    """Gains, colour matrix and upright view from a METADATA file."""

    white_balance: tuple[float, float, float]
    matrix: Tensor
    upright_view: int


def colour_of(file: Path) -> Colour:
    tags: dict[str, Any] = read_value(file, "metadata")
    try:
        gains, matrix = gains_from_neutral(tags["AsShotNeutral"]), srgb_from_camera(tags["ColorMatrix2"])
        return Colour(gains, matrix, view_of_orientation(int(tags.get("Orientation", 1))))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{file}: has no valid AsShotNeutral and ColorMatrix2 ({error}); download it again") from error


def _turned_back(file: Path, view: int, max_pixels: int) -> Tensor:
    """The upright picture in ``file`` as the sensor saw it."""
    return _even(turn_back(read_picture(file, max_pixels), view)).contiguous()


def _even(image: Tensor) -> Tensor:
    height, width = (side // 2 * 2 for side in image.shape[-2:])
    return image[..., :height, :width]


LEAST_LIKENESS = 0.8
"""Minimum correlation of the greens for pictures that show the blocks of the mosaics."""


def turn_like(pictures: Tensor, mosaics: Tensor, cfa: CFA, what: str) -> Tensor:
    """The pictures ``(K, 3, H, W)`` of a frame's blocks, turned as their mosaics ``(K, 1, H, W)`` are."""
    square = pictures.shape[-2] == pictures.shape[-1]
    views = range(bayer.N_VIEWS if square else bayer.N_VIEWS // 2)
    planes = bayer.pack(mosaics, cfa)
    raw = (planes[:, 1] + planes[:, 2]).clamp_min(0.0).sqrt()
    green = F.avg_pool2d(pictures[:, 1:2].float(), 2)[:, 0]
    likeness = torch.stack([_correlation(bayer.turn_back(green, view), raw) for view in views])
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
    """Calls ``read`` once; its value, or its error, is that of every call."""

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


class _Known(NamedTuple):
    """A frame of blocks: its name, phone and pattern, and its published levels and colour if there are any."""

    name: str
    camera: str
    cfa: CFA
    levels: tuple[float, float] | None = None
    colour: Colour | None = None


class _Blocks(LazyPairs):
    """Blocks, read all at once; what the 32 blocks of a frame share is kept for the last frame."""

    def __init__(self, path: Path, frames: Sequence[str]) -> None:
        self.path = path
        self._all = Once(self._read_all)
        self._frame: tuple[int, dict[str, Tensor], dict[str, Any]] | None = None
        super().__init__([f"{name}_{block:02d}" for name in frames for block in range(BLOCKS)])

    @abstractmethod
    def _read_all(self) -> dict[str, Tensor]:
        """``raw``, ``noisy`` and, where there are pictures, ``srgb`` and ``noisy_srgb``, ``(frames, 32, C, H, W)``."""

    @abstractmethod
    def _known(self, number: int) -> _Known:
        """What is known of the frame with this number."""

    def read(self, index: int) -> Pair:
        number, block = divmod(index, BLOCKS)
        if self._frame is None or self._frame[0] != number:
            self._frame = number, *self._shared(number)
        _, images, shared = self._frame
        known: dict[str, Any] = {key: image[block] for key, image in images.items()} | shared
        return develop_pair(self.names[index], **known)

    def _shared(self, number: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The images of a frame's blocks, turned alike, and what else of a :class:`Pair` they share."""
        images, known = {key: every[number] for key, every in self._all().items()}, self._known(number)
        for key in {"srgb", "noisy_srgb"} & images.keys():
            images[key] = turn_like(images[key], images["raw"], known.cfa, f"{self.path}: {known.name}")
        shot_var, read_var = known.levels or measure_noise(images["raw"].numpy(), images["noisy"].numpy())
        gains, matrix, _ = known.colour or _NO_COLOUR
        return images, {
            "cfa": known.cfa,
            "camera": known.camera,
            "white_balance": gains,
            "color_matrix": matrix,
            "shot_var": shot_var,
            "read_var": read_var,
            "levels_from_clean": known.levels is None,
            "color_known": known.colour is not None,
            "rendered": "srgb" in images or known.colour is not None,
        }


class SiddBlocks(_Blocks):
    """The validation blocks, 1,280 pairs; all stay in memory (0.7 GB, pictures 0.5 GB) once the first is read.

    Noise levels are those of a ``noise_level_functions.csv`` if there is one below the folder with the scene
    instance, else measured on the 32 blocks of a frame against the clean ones.
    """

    def __init__(self, path: str | Path) -> None:
        self.files = [find_file(Path(path), f"Validation{kind}BlocksRaw.mat") for kind in ("Gt", "Noisy")]
        super().__init__(Path(path), HELD_BACK)

    def _known(self, number: int) -> _Known:
        name = HELD_BACK[number]
        return _Known(name, *phone_of(name), self._levels.get(name), self._colours.get(name))

    def _read_all(self) -> dict[str, Tensor]:
        clean, noisy = (blocks_of_scenes(file) for file in self.files)
        _require_same_shape(clean, noisy, self.files[1])
        self._levels = noise_level_functions(self.path)
        self._colours = _colours(self.path)
        pictures = _pictures(self.path, "Validation{}BlocksSrgb.mat", ("Gt", "Noisy"), clean)
        return {"raw": clean, "noisy": noisy, **pictures}


class SiddBenchmark(Lazy[RawFrame]):
    """The noisy blocks of ``BenchmarkNoisyBlocksRaw.mat`` below a folder, with their levels where these are published.

    Results go to :func:`write_submission`, in the same order.
    """

    def __init__(self, path: str | Path) -> None:
        self.levels = noise_level_functions(Path(path))
        self._all = Once(partial(blocks_of_scenes, find_file(Path(path), "BenchmarkNoisyBlocksRaw.mat")))
        super().__init__([f"{scene}_{block:02d}" for scene in HELD_BACK for block in range(BLOCKS)])

    def read(self, index: int) -> RawFrame:
        scene, block = divmod(index, BLOCKS)
        (_, cfa), levels = phone_of(HELD_BACK[scene]), self.levels.get(HELD_BACK[scene])
        return RawFrame(self._all()[scene, block], cfa, noise_profile=levels, name=self.names[index], color_known=False)


def write_submission(path: str | Path, blocks: Iterable[Tensor], side: int = 256) -> None:
    """Write 1,280 denoised mosaics ``(1, side, side)`` in [0, 1], in the order and patterns of :class:`SiddBenchmark`.

    Raises:
        ValueError: if ``path`` is not a .csv file, or the server would refuse the blocks.
    """
    path = Path(path)
    if path.suffix != ".csv":
        raise ValueError(f"{path}: a SIDD submission must be a .csv file")
    rows = []
    for k, block in enumerate(blocks):
        if block.shape != (1, side, side) or not (block.min() >= 0.0 and block.max() <= 1.0):  # NaN is refused as well
            raise ValueError(
                f"block {k}: must have values in [0, 1] and shape (1, {side}, {side}): {tuple(block.shape)}"
            )
        rows.append((k, base64.b64encode(block[0].cpu().numpy().astype("<f4").tobytes()).decode()))
    if len(rows) != len(HELD_BACK) * BLOCKS:
        raise ValueError(f"{path}: a submission must have {len(HELD_BACK) * BLOCKS} blocks, got {len(rows)}")
    with path.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["ID", "BLOCK"])
        table.writerows(rows)


@DATASETS.register("siddplus")
class SiddPlusBlocks(_Blocks):
    """The validation blocks of SIDD+, 1,024 pairs, whatever the split; noise is measured as for :class:`SiddBlocks`."""

    def __init__(self, path: str | Path, split: str = "test") -> None:
        self.files = [find_file(Path(path), f"siddplus_valid_{kind}_raw.mat") for kind in ("gt", "noisy")]
        self.cfas = _patterns(find_file(Path(path), "siddplus_*bayer_patterns.csv"))
        super().__init__(Path(path), [f"siddplus_{k:02d}" for k in range(len(self.cfas))])

    def _known(self, number: int) -> _Known:
        return _Known(f"frame {number}", "SIDD+", self.cfas[number])

    def _read_all(self) -> dict[str, Tensor]:
        clean, noisy = (to_raw(read_array(file, file.stem), 3, file) for file in self.files)
        _require_same_shape(clean, noisy, self.files[1])
        if len(clean) != len(self):
            raise ValueError(f"{self.files[0]}: has {len(clean)} blocks, but there are patterns for {len(self)}")
        pictures = _pictures(self.path, "siddplus_valid_{}_srgb.mat", ("gt", "noisy"), clean)
        images = {"raw": clean, "noisy": noisy, **pictures}
        return {key: every.unflatten(0, (-1, BLOCKS)) for key, every in images.items()}


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
    found = [path] if path.is_file() and path.match(pattern) else _matching(path, pattern)
    if not found:
        raise FileNotFoundError(f"{path}: contains no {pattern}; docs/datasets.md says where to get it")
    if len(found) > 1:
        raise ValueError(f"{path}: contains {len(found)} files {pattern}, such as {found[0]}; give a folder with one")
    return found[0]


def _matching(folder: Path, pattern: str) -> list[Path]:
    return sorted(file for file in files_below(folder) if fnmatchcase(file.name, pattern))


def _pictures(path: Path, pattern: str, kinds: tuple[str, str], clean: Tensor) -> dict[str, Tensor]:
    """Pictures uint8 of the clean and noisy blocks, with the axes of ``clean``, as far as their files exist."""
    found, expected = {}, (*clean.shape[:-3], *clean.shape[-2:], 3)
    for key, kind in zip(("srgb", "noisy_srgb"), kinds, strict=True):
        if not _matching(path, name := pattern.format(kind)):
            continue
        file = find_file(path, name)
        array = read_array(file, file.stem)
        if array.dtype.name != "uint8" or array.shape != expected:
            raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the mosaics need uint8 {expected}")
        found[key] = torch.from_numpy(array).movedim(-1, -3)
    return found


def _patterns(file: Path) -> list[CFA]:
    require_file(file)
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            names = [row[0].strip().upper() for row in csv.reader(stream) if row]
        return [CFA(name) for name in names]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{file}: is not a list of patterns, one for each frame ({error}); copy it again") from None


def blocks_of_scenes(file: Path) -> Tensor:
    """``(40, 32, 1, H, W)``."""
    blocks = to_raw(read_array(file, file.stem), 4, file)
    if blocks.shape[:2] != (len(HELD_BACK), BLOCKS):
        raise ValueError(f"{file}: holds {tuple(blocks.shape[:2])} blocks, the published file {len(HELD_BACK), BLOCKS}")
    return blocks


def _colours(path: Path) -> dict[str, Colour]:
    files = {scene: found["METADATA_RAW"] for (scene, _), found in index_files(path).items() if "METADATA_RAW" in found}
    return {scene: colour_of(file) for scene, file in files.items() if scene in HELD_BACK}


def _require_same_shape(clean: Tensor, noisy: Tensor, file: Path) -> None:
    if clean.shape != noisy.shape:
        raise ValueError(f"{file}: holds {tuple(noisy.shape)}, its clean counterpart {tuple(clean.shape)}")
