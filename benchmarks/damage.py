"""Small whole files of every kind that rawaug reads, and damage to them; the inputs of benchmarks/fuzz.py."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

HEADER = 4096
"""Bytes at the beginning, and at the end, that most of the damage is done to: there the directories are."""

NUMBERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**62)
"""Lengths, counts and offsets that are seldom right."""


def make_originals(folder: Path) -> dict[str, list[Path]]:
    """Whole files by kind; the list of an unavailable kind is empty."""
    shared = Path(os.environ.get("RAWAUG_SHARED", Path(__file__).parents[1].parent / "shared" / "data"))
    return {
        "raw": sorted(shared.glob("raw/canon/*.crw"))[:3],
        "dng": _make_dngs(folder, sorted(shared.glob("raw/*/*.dng"))[:1]),
        "jpeg": _make_jpegs(folder, sorted(shared.glob("raw_jpeg/*/*.jpg"))[:1]),
        "picture": _make_pictures(folder),
        "mat5": _make_mat5(folder),
        "mat73": _make_mat73(folder),
        "safetensors": _make_safetensors(folder),
        "npy": _make_npy(folder),
        "recipe": _make_recipes(folder),
    }


def _make_dngs(folder: Path, real: list[Path]) -> list[Path]:
    """One with gain maps, and one with all the tags of a real file."""
    import torch

    from rawaug.bayer import CFA
    from rawaug.io import GainMap, RawFrame, read_raw, write_dng
    from rawaug.io.raw import Exposure

    gains = torch.rand(1, 3, 4, generator=torch.Generator().manual_seed(0)) + 1
    frame = RawFrame(
        mosaic=torch.rand(1, 64, 96, generator=torch.Generator().manual_seed(1)),
        cfa=CFA.GRBG,
        black=(512.0, 513.0, 511.0, 512.0),
        white=16383.0,
        white_balance=(2.0, 1.0, 1.5),
        daylight=(1.9, 1.0, 1.6),
        color_matrix=torch.tensor([[1.7, -0.5, -0.2], [-0.3, 1.6, -0.3], [0.0, -0.6, 1.6]]),
        camera="Maker Model",
        iso=800.0,
        noise_profile=(1e-3, 1e-5),
        orientation=1,
        name="own",
        gain_maps=(GainMap((0, 0, 64, 96), (2, 2), (0, 1), (0.0, 0.0), (0.5, 1 / 3), gains),),
        exposure=Exposure(0.01, 2.0, 35.0, "2020:01:01 00:00:00"),
    )
    write_dng(folder / "own.dng", frame)
    for source in real:
        full = read_raw(source)
        small = RawFrame(**{**vars(full), "mosaic": full.mosaic[:, :64, :96]})
        write_dng(folder / "real.dng", small, source=source)
    return sorted(folder.glob("*.dng"))


def _make_jpegs(folder: Path, real: list[Path]) -> list[Path]:
    from PIL import Image, ImageCms

    colour = Image.fromarray(_numbers(0, (120, 160, 3)))
    turned = Image.Exif()
    turned[274] = 6
    colour.save(folder / "exif.jpg", quality=90, exif=turned)
    colour.save(folder / "progressive.jpg", progressive=True)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    colour.save(folder / "profile.jpg", icc_profile=profile.replace("sRGB".encode("utf-16-be"), b"\0o\0w\0n\0 "))
    colour.convert("L").save(folder / "grey.jpg")
    for source in real:
        with Image.open(source) as picture:
            picture.crop((0, 0, 320, 240)).save(folder / "real.jpg", exif=picture.getexif())
    return sorted(folder.glob("*.jpg"))


def _make_pictures(folder: Path) -> list[Path]:
    import OpenImageIO as oiio
    from PIL import Image

    files = [folder / f"picture{end}" for end in (".png", ".tif", ".webp", ".gif", ".bmp", ".ppm")]
    for file in files:
        Image.fromarray(_numbers(0, (60, 80, 3))).save(file)
    for end, kind in ((".exr", "half"), (".jxl", "uint8")):
        output = oiio.ImageOutput.create(str(folder / f"picture{end}"))
        if output is not None and output.open(
            output_name := str(folder / f"picture{end}"), oiio.ImageSpec(80, 60, 3, kind)
        ):
            output.write_image(_numbers(0, (60, 80, 3)))
            output.close()
            files.append(Path(output_name))
    return files


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
    import torch

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
            (_flip, _cut, _overwrite, _exchange, _repeat)[int(rng.integers(5))](data, rng)
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


def _exchange(data: bytearray, rng: np.random.Generator) -> None:
    size = min(1 << int(rng.integers(2, 11)), len(data) // 2)
    a, b = (min(_place(data, rng), len(data) - size) for _ in range(2))
    data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]


def _repeat(data: bytearray, rng: np.random.Generator) -> None:
    """A piece twice, or not at all: what follows is shifted."""
    size, place = 1 << int(rng.integers(0, 9)), _place(data, rng)
    if rng.random() < 0.5:
        data[place:place] = data[place : place + size]
    else:
        del data[place : place + size]
