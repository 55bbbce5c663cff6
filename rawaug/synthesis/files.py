r"""A pair on disk: ``NAME.npz``, or ``NAME_clean`` and ``NAME_noisy`` as ``.dng``, ``.tif`` or ``.png``.

:mod:`rawaug.data.formats` describes their contents. The noisy frames of a burst are ``NAME_noisy_0`` and so on, or one
array in NPZ. ``NAME.safetensors``, the parameters that replay the pair, is written last. A pair exists if they do, its
picture is the one that they name, and its other files have the sizes that they state. A DNG's black level is as high as
the darkest noisy value needs, so that nothing is clipped at black; all files of a pair have the same levels.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.formats import write_npz, write_tiff
from rawaug.files import digest, find_weights, read_header, sha256, write_bytes, write_tensors
from rawaug.io import GainMap, RawFrame, read_picture, write_dng
from rawaug.io.pictures import MAX_PIXELS, encode_png
from rawaug.isp.functional import frame_coordinates
from rawaug.isp.stages import FALLOFF_NODES, ColorCorrection, FallOff, LensShading, WhiteBalance
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.config import AugmentConfig, pair_generator
from rawaug.plugin.params import AugmentParams, RawPair, load_params
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Target
from rawaug.version import __version__

_LONGEST_STEM = 200
"""Maximum number of bytes of a picture's name in the names of its pairs, which have at most 255."""

_WHITE = 65535
"""White level of DNGs."""

_BLACK_STEP = 256
"""The step of the black levels of DNGs, which are its multiples."""

_SHADING_NODES = (25, 33)
"""Number of rows and columns of a gain map."""

Format = Literal["dng", "npz", "tiff", "png", "webdataset"]
TARGETS: dict[Format, tuple[Target, ...]] = {"dng": ("raw",), "png": ("srgb",)}
"""The targets that a format can hold; formats that are not listed hold any target."""


@dataclass(frozen=True)
class Settings:
    """The settings, besides the pictures, that a run's files depend on; ``synth.json`` beside the files holds them."""

    format: Format
    config: AugmentConfig
    isp_sha256: str
    seed: int

    def to_json(self) -> dict[str, Any]:
        """The settings as a flat dict for ``synth.json``."""
        return {"format": self.format, "isp_sha256": self.isp_sha256, "seed": self.seed, **self.config.to_json()}


@dataclass(frozen=True)
class Origin:
    """The picture and the settings that a pair was made from; with its parameters they replay the pair."""

    picture: str
    picture_sha256: str
    isp_sha256: str
    settings: dict[str, Any]
    version: str = __version__


class Synthesiser:
    """Makes the pairs of pictures under fixed settings; a picture of more than ``max_pixels`` is refused."""

    def __init__(self, settings: Settings, max_pixels: int = MAX_PIXELS) -> None:
        self.settings, self.max_pixels = settings, max_pixels
        self.augment = settings.config.make()

    def pairs(self, picture: Path, key: str, numbers: Iterable[int]) -> tuple[Origin, Iterator[tuple[int, RawPair]]]:
        """Read a picture, and make its pairs one by one.

        Args:
            picture: an sRGB file.
            key: the picture's name in its folder, which keys the draws.
            numbers: the numbers of the pairs to make.

        Returns:
            The origin of the pairs, and an iterator over (number, pair), where the pair has no leading B.

        Raises:
            OSError, ValueError: if the picture cannot be read, or changes meanwhile.
        """
        srgb = trim_to_even(read_picture(picture, self.max_pixels)).contiguous()
        settings = self.settings
        origin = Origin(str(picture), sha256(picture), settings.isp_sha256, settings.config.to_json())

        def make_pairs() -> Iterator[tuple[int, RawPair]]:
            for number in numbers:
                params = self.augment.sample(srgb, pair_generator(settings.seed, key, number))
                yield number, self.augment.apply(srgb, params)

        return origin, make_pairs()


def pair_levels(pair: RawPair) -> dict[str, float]:
    """Get ``shot_var`` and ``read_var`` of a pair, if its noise has them."""
    noise = pair.params.noise
    levels: dict[str, float] = {}
    for key in ("shot_var", "read_var"):
        if key in noise:
            levels[key] = noise[key].item()
    return levels


def replay_pair(
    params: AugmentParams, origin: Origin, label: object, picture: str | Path | None, isp: str | Path | None
) -> RawPair:
    """Make a pair again from its parameters.

    Args:
        params: parameters of one pair, without the leading B.
        origin: what the pair was made from.
        label: names the pair in messages.
        picture: the sRGB picture, if it has moved since.
        isp: the ISP's file, if it has moved since.

    Raises:
        ValueError: if the picture or the ISP has changed.
    """
    config = AugmentConfig.from_json(origin.settings)
    config = replace(config, isp=str(isp or config.isp))
    if sha256(find_weights(config.isp)) != origin.isp_sha256:
        raise ValueError(f"{label}: the ISP {config.isp} is not the one this pair was made with")

    path = Path(picture or origin.picture)
    srgb = trim_to_even(read_picture(path))
    if sha256(path) != origin.picture_sha256:
        raise ValueError(f"{label}: the picture {path} has changed since this pair was made")

    pair: RawPair = config.make().apply(srgb, params)
    return pair


class PictureJob:
    """The pairs of one picture.

    Args:
        picture: an sRGB file.
        key: its name in the folder, which keys the draws.
        stem: the beginning of its pairs' files.
        per_image: number of pairs that the picture is to have.
    """

    pictures = 1

    def __init__(self, picture: Path, key: str, stem: Path, per_image: int) -> None:
        self.picture = picture
        self.key = key
        self.stem = stem
        self.per_image = per_image

    def make(self, maker: Synthesiser) -> tuple[int, int, dict[str, str]]:
        """Write the pairs that are missing; each one that is there says itself which picture it was made of.

        Returns:
            The number of pairs that were made, the number of those that were there, and the reason if the picture
            cannot be read, which is tried again by the next run.
        """
        picture_sha256 = None
        missing = []
        for number in range(self.per_image):
            params = Path(f"{self.stem}_{number}.safetensors")
            if params.exists() and picture_sha256 is None:
                picture_sha256 = sha256(self.picture)
            if not params.exists() or not _is_whole(params, picture_sha256):
                missing.append(number)

        existing = self.per_image - len(missing)
        if not missing:
            return 0, existing, {}
        try:
            origin, pairs = maker.pairs(self.picture, self.key, missing)
        except (OSError, ValueError) as error:
            return 0, existing, {self.key: str(error)}

        for number, pair in pairs:
            write_pair(Path(f"{self.stem}_{number}"), pair, maker.augment, maker.settings.format, origin)
        return len(missing), existing, {}


def _is_whole(params: Path, picture_sha256: str | None) -> bool:
    """Tell whether a pair with these parameters is of this picture, and has its other files in their sizes."""
    try:
        header = read_header(params)
        origin, sizes = json.loads(header["origin"]), json.loads(header["sizes"])
    except (ValueError, KeyError):
        return False

    files = [params.with_name(name) for name in sizes]
    are_whole = [file.is_file() and file.stat().st_size == sizes[file.name] for file in files]
    return origin["picture_sha256"] == picture_sha256 and all(are_whole)


def picture_jobs(pictures: Sequence[Path], source: Path, out: Path, per_image: int) -> Iterator[PictureJob]:
    """Make one job for each picture; pictures that differ only in their extension keep it in their pairs' names.

    Args:
        pictures: sRGB files below ``source``.
        source: the folder of the pictures.
        out: the folder of the pairs, whose subfolders are those of ``source``.
        per_image: number of pairs of each picture.

    Raises:
        ValueError: if the pairs of two pictures would have the same names.
    """
    stems = Counter(picture.with_suffix("") for picture in pictures)
    picture_of: dict[Path, Path] = {}
    for picture in pictures:
        stem = picture.with_suffix("")
        if stems[stem] > 1:
            stem = stem.with_name(picture.name.replace(".", "_"))
        namesake = picture_of.setdefault(stem, picture)
        if namesake != picture:
            raise ValueError(f"{picture}: its pairs would have the same names as those of {namesake.name}; rename one")

        stem = out / stem.relative_to(source).with_name(_short(stem.name))
        yield PictureJob(picture, picture.relative_to(source).as_posix(), stem, per_image)


def _short(name: str) -> str:
    """Shorten a name, and add a hash, if the pairs' file names would become too long."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST_STEM:
        return name
    return encoded[: _LONGEST_STEM - 20].decode("utf-8", "ignore") + f"-{digest(encoded)[:16]}"


def write_pair(stem: Path, pair: RawPair, augment: RawAugment, format: Format, origin: Origin) -> None:
    """Write a pair and its parameters.

    Args:
        stem: the beginning of the files' names.
        pair: one pair, without the leading B.
        augment: the augmentation that made it.
        format: a format of files, not of shards.
        origin: what the pair was made from.
    """
    files = _WRITERS[format](stem, pair, augment)

    sizes = {file.name: file.stat().st_size for file in files}
    header = {"format": "rawaug", "kind": "augment_params", "origin": json.dumps(asdict(origin))}
    header["sizes"] = json.dumps(sizes)
    write_tensors(pair.params.tensors(), header, f"{stem}.safetensors")


def _images(pair: RawPair, augment: RawAugment) -> dict[str, Tensor]:
    """Get the images of a pair, ``(C, H, W)`` each, by the end of their files' names."""
    images = {"_clean": pair.clean}
    if augment.burst is None:
        images["_noisy"] = pair.noisy
    else:
        for number, frame in enumerate(pair.noisy):
            images[f"_noisy_{number}"] = frame

    for end, image in images.items():
        if len(image) != 3:
            images[end] = augment.mosaic(image)
    return images


def _write_dngs(stem: Path, pair: RawPair, augment: RawAugment) -> list[Path]:
    frames, stops = camera_frames(pair, augment)
    files = []
    for end, frame in frames.items():
        files.append(Path(f"{stem}{end}.dng"))
        write_dng(files[-1], frame, baseline_exposure=stops)
    return files


def _write_npz(stem: Path, pair: RawPair, augment: RawAugment) -> list[Path]:
    file = Path(f"{stem}.npz")
    write_npz(file, pair.clean, pair.noisy, _metadata(pair, augment))
    return [file]


def _write_tiffs(stem: Path, pair: RawPair, augment: RawAugment) -> list[Path]:
    files = []
    for end, image in _images(pair, augment).items():
        if augment.target == "srgb":  # viewers expect integers
            image = (image * 65535.0).round().to(torch.uint16)
        files.append(Path(f"{stem}{end}.tif"))
        write_tiff(files[-1], image, _metadata(pair, augment))
    return files


def _write_pngs(stem: Path, pair: RawPair, augment: RawAugment) -> list[Path]:
    files = []
    for end, image in _images(pair, augment).items():
        files.append(Path(f"{stem}{end}.png"))
        write_bytes(encode_png(image), files[-1])
    return files


_WRITERS: dict[Format, Callable[[Path, RawPair, RawAugment], list[Path]]] = {
    "dng": _write_dngs,
    "npz": _write_npz,
    "tiff": _write_tiffs,
    "png": _write_pngs,
}


def replay(params: str | Path, picture: str | Path | None = None, isp: str | Path | None = None) -> RawPair:
    """Make a pair again from its file of parameters, bit for bit as it was written.

    Args:
        params: ``NAME.safetensors`` of a pair.
        picture: the sRGB picture, if it has moved since.
        isp: the ISP's file, if it has moved since.

    Raises:
        ValueError: if ``rawaug synth`` has not written the file, or the picture or the ISP has changed.
    """
    header = read_header(params)
    if "origin" not in header:
        raise ValueError(f"{params}: not written by rawaug synth; use RawAugment.apply")

    origin = Origin(**json.loads(header["origin"]))
    return replay_pair(load_params(params), origin, params, picture, isp)


def _metadata(pair: RawPair, augment: RawAugment) -> dict[str, Any]:
    """Get the metadata of a pair in NPZ and TIFF; colour that cannot be inverted is left out."""
    if augment.target == "srgb":
        return pair_levels(pair)

    metadata: dict[str, Any] = {"cfa": augment.cfa, **pair_levels(pair)}
    try:
        white_balance, matrix, _ = _color(pair, augment)
    except (ValueError, RuntimeError):
        return metadata
    return metadata | {"white_balance": list(white_balance), "color_matrix": matrix.tolist()}


def camera_frames(pair: RawPair, augment: RawAugment) -> tuple[dict[str, RawFrame], float]:
    """Describe the mosaics of a RAW pair, without the leading B, as frames of a camera.

    Returns:
        The frames by the ends of their files' names, and the number of stops by which they are underexposed.

    Raises:
        ValueError: if a DNG cannot store the white balance of the pair.
    """
    white_balance, color_matrix, stops = _color(pair, augment)
    metadata: dict[str, Any] = {
        "cfa": augment.cfa,
        "black": (_black(float(pair.noisy.min())),) * 4,
        "white": float(_WHITE),
        "white_balance": white_balance,
        "daylight": white_balance,
        "color_matrix": color_matrix,
        "camera": "rawaug dictionary ISP",
        "gain_maps": _shading_maps(augment, pair),
    }
    levels = pair_levels(pair)
    profile = None
    if len(levels) == 2:
        profile = levels["shot_var"], levels["read_var"]

    frames = {}
    for end, mosaic in _images(pair, augment).items():
        if end == "_clean":
            frames[end] = RawFrame(mosaic=mosaic, noise_profile=None, **metadata)
        else:
            frames[end] = RawFrame(mosaic=mosaic, noise_profile=profile, **metadata)
    return frames, stops


def _color(pair: RawPair, augment: RawAugment) -> tuple[tuple[float, float, float], Tensor, float]:
    """Get white balance, the matrix from white-balanced camera colour to linear sRGB, and stops of underexposure."""
    # With raw = C x / gains for linear sRGB x, grey is s / gains in the camera, where s are the sums of C's rows. So
    # white balance is gains / s, whose green is the exposure, and C with its rows over s is the matrix's inverse.
    setting = pair.params.isp
    matrix = setting.matrix if augment.isp.stages.find(ColorCorrection) else torch.eye(3)
    gains = setting.gains if augment.isp.stages.find(WhiteBalance) else torch.ones(3)
    grey = matrix.sum(1)
    balance = gains / grey
    if not balance.min() > 0:
        raise ValueError(f"a DNG cannot store the white balance {balance.tolist()} of this pair; it must be positive")

    red, green, blue = balance.tolist()
    return (red / green, 1.0, blue / green), torch.linalg.inv(matrix / grey[:, None]), math.log2(green)


def _black(darkest: float) -> float:
    """Find the lowest multiple of 256 at which ``darkest`` is a digital number: d = y (white - black) + black >= 0."""
    depth = max(0.0, -darkest)
    black = depth / (1 + depth) * _WHITE
    return float(_BLACK_STEP * max(1, math.ceil(black / _BLACK_STEP)))


def _shading_maps(augment: RawAugment, pair: RawPair) -> tuple[GainMap, ...]:
    """Make gain maps that correct the shading, if the ISP has any: its Gaussian part, or the tables of a camera."""
    height, width = augment.mosaic(pair.clean).shape[-2:]
    falloff = augment.isp.stages.find(FallOff)
    if falloff is not None:
        tables = torch.einsum("n,nchw->chw", pair.params.isp.colour_weights, falloff.tables)
        spacing = 1 / (FALLOFF_NODES - 1)
        maps = []
        for colour, (row, column) in zip((0, 1, 1, 2), CFA(augment.cfa).sites, strict=True):
            corrections = GainMap(
                area=(row, column, height, width),
                pitch=(2, 2),
                planes=(0, 1),
                origin=(0.0, 0.0),
                spacing=(spacing, spacing),
                gains=1 / tables[colour : colour + 1],
            )
            maps.append(corrections)
        return tuple(maps)

    lens = augment.isp.stages.find(LensShading)
    if lens is None:
        return ()

    rows, columns = _SHADING_NODES
    y = torch.linspace(0, height, rows) - height / 2
    x = torch.linspace(0, width, columns) - width / 2
    coordinates = torch.stack(torch.meshgrid(y, x, indexing="ij"))[None] / (0.5 * (height**2 + width**2) ** 0.5)
    mask = lens.mask(coordinates.to(frame_coordinates(1, 1)))[0]

    correction = GainMap(
        area=(0, 0, height, width),
        pitch=(1, 1),
        planes=(0, 1),
        origin=(0.0, 0.0),
        spacing=(1 / (rows - 1), 1 / (columns - 1)),
        gains=1 / mask.detach(),
    )
    return (correction,)
