"""Picture files that are written keep their bits, their metadata and their transparency."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.io.pictures import read_stored, write_stored

oiio = pytest.importorskip("OpenImageIO")


def written(path: Path, pixels: np.ndarray, **attributes: object) -> Path:
    spec = oiio.ImageSpec(
        pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype).replace("float32", "float")
    )
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()
    return path


def numbers(dtype: type, channels: int) -> np.ndarray:
    most = np.iinfo(dtype).max
    return np.random.default_rng(0).integers(0, most, (20, 31, channels), endpoint=True).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("extension", ["png", "tif"])
def test_a_picture_comes_back_bit_for_bit(dtype: type, channels: int, extension: str, tmp_path: Path) -> None:
    pixels = numbers(dtype, channels)
    if channels == 4:
        pixels[..., 3] = np.iinfo(dtype).max
    source = written(tmp_path / f"in.{extension}", pixels, Orientation=6)
    picture = read_stored(source)
    assert picture.srgb.shape == (3, 20, 31) and picture.srgb.dtype == torch.float32
    write_stored(tmp_path / f"out.{extension}", picture.srgb, picture)
    again = oiio.ImageInput.open(str(tmp_path / f"out.{extension}"))
    assert np.array_equal(again.read_image(str(pixels.dtype)), pixels)
    assert again.spec().get_int_attribute("Orientation") == 6


def test_a_jpeg_keeps_its_exif_and_its_size(tmp_path: Path) -> None:
    pixels = np.full((40, 60, 3), 120, np.uint8)
    source = written(tmp_path / "in.jpg", pixels, Orientation=8, Make="Camera", ExposureTime=0.01)
    picture = read_stored(source)
    write_stored(tmp_path / "out.jpg", picture.srgb, picture)
    spec = oiio.ImageInput.open(str(tmp_path / "out.jpg")).spec()
    assert (spec.width, spec.height, spec.get_int_attribute("Orientation")) == (60, 40, 8)
    assert spec.get_string_attribute("Make") == "Camera"
    assert spec.get_float_attribute("ExposureTime") == pytest.approx(0.01, rel=1e-3)


def test_an_icc_profile_goes_with_the_picture(tmp_path: Path) -> None:
    image, cms = pytest.importorskip("PIL.Image"), pytest.importorskip("PIL.ImageCms")
    profile = cms.ImageCmsProfile(cms.createProfile("sRGB")).tobytes()
    image.fromarray(numbers(np.uint8, 3)).save(tmp_path / "in.png", icc_profile=profile)
    picture = read_stored(tmp_path / "in.png")
    for name in ("out.png", "out.tif", "out.jpg"):
        write_stored(tmp_path / name, picture.srgb, picture)
        with image.open(tmp_path / name) as stored:
            assert stored.info["icc_profile"] == profile


def test_16_bits_become_8_in_a_jpeg(tmp_path: Path) -> None:
    flat = np.full((16, 16, 3), 128 * 257, np.uint16)
    picture = read_stored(written(tmp_path / "in.tif", flat))
    write_stored(tmp_path / "out.jpg", picture.srgb, picture)
    assert (oiio.ImageInput.open(str(tmp_path / "out.jpg")).read_image("uint8") == 128).all()


def test_other_numbers_and_extensions_are_refused_in_a_line(tmp_path: Path) -> None:
    source = written(tmp_path / "in.tif", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ValueError, match="holds float numbers"):
        read_stored(source)
    picture = read_stored(written(tmp_path / "in.png", numbers(np.uint8, 3)))
    with pytest.raises(ValueError, match=r"out\.bmp: cannot be written; use one of \.jpg"):
        write_stored(tmp_path / "out.bmp", picture.srgb, picture)
