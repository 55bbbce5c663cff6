"""Small whole files of every kind that rawaug reads, and damage to them; what fuzz.py and faults.py share.

A mutation takes the bytes of a whole file and a generator, and gives those of a hostile one. Those of formats that
rawaug itself parses know the structure of the file: directories in a circle, sizes and counts beyond reason, values
exchanged, parts twice or missing.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.io import RawFrame

HEADER = 4096
"""Bytes at the beginning, and at the end, that most of the damage is done to: there the directories are."""

NUMBERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**62)
"""Lengths, counts and offsets that are seldom right."""

IMPORTED = "this"
"""A harmless module that nothing imports: a recipe that names it must not either."""


def fifo(path: Path) -> None:
    os.mkfifo(path)


def itself(path: Path) -> None:
    path.symlink_to(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


IRREGULAR: tuple[Callable[[Path], None], ...] = (fifo, itself, endless)
"""What has the name of a file, and is none that ends."""


def make_originals(folder: Path) -> dict[str, list[Path]]:
    """Whole files by kind; the list of an unavailable kind is empty."""
    shared = Path(os.environ.get("RAWAUG_SHARED", Path(__file__).parents[1].parent / "shared" / "data"))
    made = {"picture": _make_pictures, "mat5": _make_mat5, "mat73": _make_mat73, "safetensors": _make_safetensors,
            "npy": _make_npy, "pair": _make_pairs, "recipe": _make_recipes}  # fmt: skip
    return {
        "raw": sorted(shared.glob("raw/canon/*.crw"))[:3],
        "dng": _make_dngs(folder, sorted(shared.glob("raw/*/*.dng"))[:1]),
        **{kind: make(folder) for kind, make in made.items()},
    }


def small_frame(mosaic: Tensor, cfa: CFA) -> RawFrame:
    """A RAW frame of a mosaic ``(1, H, W)``, with everything that a DNG states; of no camera."""
    matrix = torch.tensor([[1.7, -0.5, -0.2], [-0.3, 1.6, -0.3], [0.0, -0.6, 1.6]])
    levels = {"black": (512.0, 513.0, 511.0, 512.0), "white": 16383.0, "iso": 800.0, "noise_profile": (1e-3, 1e-5)}
    colours = {"white_balance": (2.0, 1.0, 1.5), "daylight": (1.9, 1.0, 1.6), "color_matrix": matrix}
    return RawFrame(mosaic, cfa, **levels, **colours, camera="Maker Model")  # type: ignore[arg-type]


def _make_dngs(folder: Path, real: list[Path]) -> list[Path]:
    """One with gain maps, and one with all the tags of a real file."""
    from rawaug.io import GainMap, read_raw, write_dng
    from rawaug.io.raw import Exposure

    gains = torch.rand(1, 3, 4, generator=torch.Generator().manual_seed(0)) + 1
    maps = (GainMap((0, 0, 64, 96), (2, 2), (0, 1), (0.0, 0.0), (0.5, 1 / 3), gains),)
    frame = small_frame(torch.rand(1, 64, 96, generator=torch.Generator().manual_seed(1)), CFA.GRBG)
    exposure = Exposure(0.01, 2.0, 35.0, "2020:01:01 00:00:00")
    write_dng(folder / "own.dng", replace(frame, orientation=1, gain_maps=maps, exposure=exposure))
    for source in real:
        full = read_raw(source)
        write_dng(folder / "real.dng", replace(full, mosaic=full.mosaic[:, :64, :96]), source=source)
    return sorted(folder.glob("*.dng"))


def _make_pictures(folder: Path) -> list[Path]:
    from PIL import Image, ImageCms

    colour, turned = Image.fromarray(_numbers(0, (60, 80, 3))), Image.Exif()
    turned[274] = 6
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    own = profile.replace("sRGB".encode("utf-16-be"), b"\0o\0w\0n\0 ")
    colour.save(folder / "exif.jpg", exif=turned)
    colour.save(folder / "profile.jpg", icc_profile=own)
    colour.save(folder / "progressive.jpg", progressive=True)
    colour.convert("L").save(folder / "grey.jpg")
    files = [folder / f"picture{end}" for end in (".png", ".tif", ".webp", ".gif", ".bmp", ".ppm")]
    for file in files:
        colour.save(file)
    return [*sorted(folder.glob("*.jpg")), *files]


def _make_mat5(folder: Path) -> list[Path]:
    from scipy.io import savemat

    for compressed in (False, True):
        savemat(folder / f"compressed{int(compressed)}.mat5.mat", _variables(), do_compression=compressed)
    return sorted(folder.glob("*.mat5.mat"))


def _make_mat73(folder: Path) -> list[Path]:
    import h5py

    path = folder / "hdf5.mat73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        variables = _variables()
        file.create_dataset("x", data=variables["x"].T, compression="gzip")
        metadata = file.create_group("metadata")
        for name, value in variables["metadata"].items():
            metadata.create_dataset(name, data=np.atleast_2d(value).T)
        inner = [file.create_dataset(f"#refs#/{k}", data=np.arange(k + 1.0)) for k in range(3)]
        cells = np.empty((1, 3), h5py.ref_dtype)
        cells[0] = [node.ref for node in inner]
        file.create_dataset("cells", data=cells).attrs["MATLAB_class"] = np.bytes_("cell")
        text = file.create_dataset("text", data=np.array([[114], [97], [119]], np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
    return [path]


def _make_safetensors(folder: Path) -> list[Path]:
    import denoisers
    from rawaug import DictionaryISP, ISPConfig, RawAugment
    from rawaug.plugin.params import save_params

    isp = DictionaryISP(ISPConfig(colour_atoms=4, gain_atoms=4, encoder_widths=(4, 4, 4)))
    isp.save(folder / "isp.safetensors")
    denoisers.save(denoisers.build("UNet", width=4, scales=2), folder / "denoiser.safetensors", {"cfa": "RGGB"})
    params = RawAugment(isp, noise=(1e-3, 1e-5)).sample(torch.zeros(3, 8, 8), torch.Generator().manual_seed(0))
    save_params(params, folder / "params.safetensors")
    return sorted(folder.glob("*.safetensors"))


def _make_npy(folder: Path) -> list[Path]:
    from PIL import Image

    np.save(folder / "packed.npy", _numbers(0, (6, 8, 4)).astype(np.uint16))
    Image.fromarray(_numbers(0, (12, 16, 3))).save(folder / "packed.png")
    return [folder / "packed.npy"]


def _make_pairs(folder: Path) -> list[Path]:
    """Mosaics that state their CFA and levels, as ``rawaug synth`` writes them."""
    from rawaug.data.formats import write_npz, write_tiff

    packed = torch.rand(4, 8, 8, generator=torch.Generator().manual_seed(0))
    stated = {"cfa": "RGGB", "shot_var": 1e-3, "read_var": 1e-5}
    write_npz(folder / "pair.npz", packed, packed, stated)
    write_tiff(folder / "pair.pair.tif", torch.nn.functional.pixel_shuffle(packed, 2), stated)
    return [folder / "pair.npz", folder / "pair.pair.tif"]


def _make_recipes(folder: Path) -> list[Path]:
    """Those that travel with the package, without what would be read when they are set up."""
    shipped = Path(__file__).parents[1] / "recipes"
    for name in ("fewshot", "unsupervised", "reconstruction"):
        (folder / f"{name}.yaml").write_bytes((shipped / f"{name}.yaml").read_bytes())
    return sorted(folder.glob("*.yaml"))


def _numbers(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def _variables() -> dict[str, Any]:
    matrix = (1.2, -0.1, -0.1, -0.4, 1.2, 0.2, -0.1, 0.1, 0.7)
    metadata = {"AsShotNeutral": np.array([0.5, 1.0, 0.6]), "ColorMatrix2": np.array(matrix), "Orientation": 6.0}
    cells = np.empty((1, 3), object)
    cells[0] = [np.arange(k + 1.0) for k in range(3)]
    return {"x": _numbers(0, (64, 96)).astype(np.float32) / 255, "metadata": metadata, "cells": cells, "text": "raw"}


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """One to three kinds of damage."""
    data = bytearray(whole)
    for _ in range(int(rng.choice(3, p=(0.7, 0.2, 0.1))) + 1):
        if len(data) > 16:
            _pick(rng, [_flip, _cut, _overwrite, _repeat])(data, rng)
    return bytes(data)


def _place(data: bytearray, rng: np.random.Generator) -> int:
    within, where = min(len(data), HEADER), rng.random()
    if where < 0.4:
        return int(rng.integers(len(data)))
    return int(rng.integers(within)) if where < 0.85 else len(data) - 1 - int(rng.integers(within))


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for _ in range(1 << int(rng.integers(5))):
        data[_place(data, rng)] ^= 1 << int(rng.integers(8))


def _cut(data: bytearray, rng: np.random.Generator) -> None:
    del data[_place(data, rng) :]


def _overwrite(data: bytearray, rng: np.random.Generator) -> None:
    """A wrong length, count or offset of 1 to 8 bytes in either byte order, often aligned as such numbers are."""
    size = (1, 2, 4, 8)[int(rng.integers(4))]
    place = _place(data, rng) // size * size if rng.random() < 0.7 else _place(data, rng)
    number = NUMBERS[int(rng.integers(len(NUMBERS)))] if rng.random() < 0.7 else int(rng.integers(2**63))
    order = "little" if rng.random() < 0.5 else "big"
    inside = (number % 256**size).to_bytes(size, order)[: len(data) - place]
    data[place : place + len(inside)] = inside


def _repeat(data: bytearray, rng: np.random.Generator) -> None:
    """A piece twice, or not at all: what follows is shifted."""
    size, place = 1 << int(rng.integers(0, 9)), _place(data, rng)
    if rng.random() < 0.5:
        data[place:place] = data[place : place + size]
    else:
        del data[place : place + size]


# -- damage that knows the structure -----------------------------------------------------------------------------------


Mutation = Callable[[bytes, np.random.Generator], bytes]


def _number(rng: np.random.Generator, size: int, near: int = 0) -> bytes:
    """A seldom number of ``size`` bytes, or one near ``near``, little-endian."""
    value = near + int(rng.integers(-8, 9)) if rng.random() < 0.3 else NUMBERS[int(rng.integers(len(NUMBERS)))]
    return (value % 256**size).to_bytes(size, "little")


def _pick(rng: np.random.Generator, items: list[Any]) -> Any:
    return items[int(rng.integers(len(items)))]


# -- TIFF and DNG ------------------------------------------------------------------------------------------------------

_SUB_IFDS = 330


def tiff(whole: bytes, rng: np.random.Generator) -> bytes:
    """An entry's code, type, count or value; a pointer into a circle."""
    import tifffile

    data, order = bytearray(whole), "<" if whole[:2] == b"II" else ">"
    with tifffile.TiffFile(io.BytesIO(whole)) as file:
        pages = [inner for page in file.pages for inner in (page, *(page.pages or ()))]
        page = _pick(rng, pages)
        entry = _pick(rng, [tag.offset for tag in page.tags])
    what, other = rng.random(), _pick(rng, pages).offset
    if what < 0.15:  # the successor
        struct.pack_into(order + "I", data, page.offset + 2 + 12 * len(page.tags), other)
    elif what < 0.3:  # children, of which each is its own parent
        struct.pack_into(order + "HHII", data, entry, _SUB_IFDS, 4, 1 if rng.random() < 0.5 else 2**20, other)
    else:
        offset, size = _pick(rng, [(0, 2), (2, 2), (4, 4), (8, 4)])
        number = _number(rng, size, int.from_bytes(data[entry + offset : entry + offset + size], "little"))
        data[entry + offset : entry + offset + size] = number if order == "<" else number[::-1]
    return bytes(data)


# -- safetensors -------------------------------------------------------------------------------------------------------

_NO_NUMBERS = ("NaN", "Infinity", "1e999")
_VALUES: list[Any] = [None, -1, 0, 10**6, 10**9, 10**30, 1e29, True, "x", "", [], {}, [1] * 10**5, *_NO_NUMBERS]


def safetensors(whole: bytes, rng: np.random.Generator) -> bytes:
    """Of the header a text, a number of its JSON, a type, shape or range; or values that are no numbers."""
    end = 8 + int.from_bytes(whole[:8], "little")
    header, content = json.loads(whole[8:end]), bytearray(whole[end:])
    texts, names = header.setdefault("__metadata__", {}), [name for name in header if name != "__metadata__"]
    what = rng.random()
    if what < 0.6 and texts:
        key = _pick(rng, sorted(texts))
        texts[key] = _changed_text(texts[key], rng)
        if rng.random() < 0.15:
            del texts[key]
    elif what < 0.8 and names:
        entry = header[_pick(rng, names)]
        field = _pick(rng, ["dtype", "shape", "data_offsets"])
        entry[field] = _pick(rng, ["F64", "I8", "BOOL", "F8_E4M3"]) if field == "dtype" else _pick(rng, _VALUES)
    elif len(content) >= 4:
        at = 4 * int(rng.integers(len(content) // 4))
        content[at : at + 4] = struct.pack("<f", _pick(rng, [np.nan, np.inf, -np.inf, 3e38]))
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + bytes(content)


def _changed_text(text: str, rng: np.random.Generator) -> str:
    """A value of a JSON object exchanged, or the text made one that no reader expects."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, dict) or not value or rng.random() < 0.2:
        return _pick(rng, ["", "null", "[]", '{"a":' * 10_000, "9" * 5000, text[: len(text) // 2]])
    value[_pick(rng, sorted(value))] = "@"
    new = _pick(rng, _VALUES)
    return json.dumps(value).replace('"@"', new if new in _NO_NUMBERS else json.dumps(new))


# -- recipes -----------------------------------------------------------------------------------------------------------


def recipe(whole: bytes, rng: np.random.Generator) -> bytes:
    """A value of a recipe exchanged, or ``module:function`` in the place of one."""
    content = yaml.safe_load(whole)
    section = content
    while True:
        key = _pick(rng, sorted(section))
        if not isinstance(section[key], dict) or not section[key]:
            break
        section = section[key]
    section[key] = _pick(rng, [*_VALUES, 1e25, float("nan"), float("inf"), f"{IMPORTED}:s"])
    return yaml.safe_dump(content).encode()


MUTATIONS: dict[str, Mutation] = {
    ".dng": tiff, ".tif": tiff, ".safetensors": safetensors, ".yaml": recipe,
}  # fmt: skip
"""By the end of a file's name; what other packages alone decode is damaged byte by byte."""
