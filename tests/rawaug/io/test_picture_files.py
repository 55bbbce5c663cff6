"""Picture files that are written keep their bits, their metadata and their transparency."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.io import read_picture
from rawaug.io.directories import DamagedTags, Tag, TiffFile, pack_directory, pointer_tag
from rawaug.io.headers import XMP_PREFIX, jpeg_segments
from rawaug.io.metadata import pack_chunk
from rawaug.io.stored import StoredPicture, read_stored, write_stored

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
    source = written(tmp_path / "in.exr", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ValueError, match="holds linear light"):
        read_stored(source)
    with pytest.raises(ValueError, match=r"bright\.tif:"):
        read_stored(written(tmp_path / "bright.tif", np.full((4, 4, 3), 2, np.float32)))
    picture = read_stored(written(tmp_path / "in.png", numbers(np.uint8, 3)))
    with pytest.raises(ValueError, match=r"out\.bmp: .*written"):
        write_stored(tmp_path / "out.bmp", picture.srgb, picture)


# -- metadata, byte for byte -------------------------------------------------------------------------------------------

XMP = b"<x:xmpmeta xmlns:x='adobe:ns:meta/' tiff:Orientation='3' exif:FocalLength='5000/100'/>"


def block(order: str = "<", thumbnail: bytes = b"") -> bytes:
    """EXIF with a maker's note, a position and a thumbnail."""
    header = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    exif_tags = [
        Tag(33434, 5, 1, struct.pack(order + "II", 1, 60)),
        Tag(37386, 5, 1, struct.pack(order + "II", 50, 1)),
        Tag(37500, 7, 24, b"maker's note, any bytes\xff"),
        Tag(40961, 3, 1, struct.pack(order + "H", 65535)),
    ]
    gps_tags = [Tag(1, 2, 2, b"N\0"), Tag(2, 5, 3, struct.pack(order + "6I", 48, 1, 8, 1, 30, 1))]

    def first(exif: int, gps: int, following: int) -> bytes:
        tags = [Tag(271, 2, 7, b"Camera\0"), Tag(274, 3, 1, struct.pack(order + "H", 6))]
        tags += [pointer_tag(order, 34665, exif), pointer_tag(order, 34853, gps)]
        return pack_directory(order, tags, 8, following)

    exif_place = 8 + len(first(0, 0, 0))
    exif = pack_directory(order, exif_tags, exif_place)
    gps_place = exif_place + len(exif)
    gps = pack_directory(order, gps_tags, gps_place)
    if not thumbnail:
        return header + first(exif_place, gps_place, 0) + exif + gps

    second_place = gps_place + len(gps)
    picture = second_place + 2 + 24 + 4
    second_tags = [
        Tag(513, 4, 1, struct.pack(order + "I", picture)),
        Tag(514, 4, 1, struct.pack(order + "I", len(thumbnail))),
    ]
    second = pack_directory(order, second_tags, second_place)
    return header + first(exif_place, gps_place, second_place) + exif + gps + second + thumbnail


def picture(value: int = 90) -> Image.Image:
    return Image.fromarray(np.full((40, 60, 3), value, np.uint8))


def encoded(image: Image.Image, kind: str, **settings: Any) -> bytes:
    file = BytesIO()
    image.save(file, kind, **settings)
    return file.getvalue()


def insert(jpeg: bytes, *segments: tuple[int, bytes]) -> bytes:
    packed = [struct.pack(">BBH", 0xFF, marker, len(data) + 2) + data for marker, data in segments]
    return jpeg[:2] + b"".join(packed) + jpeg[2:]


def again(source: Path, out: Path) -> StoredPicture:
    stored = read_stored(source)
    write_stored(out, stored.srgb, stored)
    return stored


def test_the_segments_of_a_jpeg_are_copied_as_they_are(tmp_path: Path) -> None:
    plain = encoded(picture(), "JPEG")
    segments = [
        (0xE1, b"Exif\0\0" + block(">")),
        (0xE1, XMP_PREFIX + XMP),
        (0xED, b"Photoshop 3.0\0any"),
        (0xFE, b"words"),
    ]
    source = tmp_path / "in.jpg"
    source.write_bytes(insert(plain, *segments) + b"a film behind the picture")
    again(source, tmp_path / "out.jpg")

    with source.open("rb") as one, (tmp_path / "out.jpg").open("rb") as other:
        kept = [segment for segment in jpeg_segments(one) if segment.marker >= 0xE0]
        assert len(kept) == 5, "JFIF, and the four"
        assert kept == [segment for segment in jpeg_segments(other) if segment.marker >= 0xE0]
    assert (tmp_path / "out.jpg").read_bytes().endswith(b"\xff\xd9a film behind the picture")


def test_a_thumbnail_is_of_the_new_picture_and_all_else_of_exif_stays(tmp_path: Path) -> None:
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (24, 16, 3), np.uint8))
    exif = block("<", encoded(noise, "JPEG", quality=95))
    (tmp_path / "in.jpg").write_bytes(insert(encoded(picture(90), "JPEG"), (0xE1, b"Exif\0\0" + exif)))
    again(tmp_path / "in.jpg", tmp_path / "out.jpg")
    with Image.open(tmp_path / "out.jpg") as image:
        new = image.info["exif"].removeprefix(b"Exif\0\0")
    place = exif.index(b"\xff\xd8")
    with Image.open(BytesIO(new[place:])) as thumbnail:
        assert thumbnail.size == (16, 24)
        assert abs(np.asarray(thumbnail).astype(int) - 90).max() <= 2
    different = [k for k in range(len(exif)) if exif[k] != new[k]]
    assert len(new) == len(exif) and min(different) >= place - 12, "but the thumbnail and its length"


def test_pictures_behind_the_first_are_found_at_their_new_place(tmp_path: Path) -> None:
    """The list of pictures of CIPA DC-007, as phones write it for a gain map."""
    base, gains = (
        encoded(Image.effect_noise((64, 48), 80).convert("RGB"), "JPEG", quality=50),
        encoded(picture(10), "JPEG"),
    )
    entry = struct.pack("<IIIHH", 0x30000, 0, 0, 0, 0) + struct.pack("<IIIHH", 0, len(gains), 0, 0, 0)
    listing = b"MPF\0II*\0" + struct.pack("<I", 8) + pack_directory("<", [Tag(45058, 7, 32, entry)], 8)
    first = len(insert(base, (0xE2, listing)))
    at = 2 + 4 + 4  # the header of the list's TIFF
    listing = listing.replace(struct.pack("<III", 0, len(gains), 0), struct.pack("<III", 0, len(gains), first - at))
    (tmp_path / "in.jpg").write_bytes(insert(base, (0xE2, listing)) + gains)
    again(tmp_path / "in.jpg", tmp_path / "out.jpg")

    data = (tmp_path / "out.jpg").read_bytes()
    assert len(data) != first + len(gains), "the picture is coded anew"
    start = data.index(b"MPF\0") + 4
    (offset,) = struct.unpack_from("<I", data, start + data[start:].index(struct.pack("<II", 0, len(gains))) + 8)
    assert data[start + offset :] == gains


@pytest.mark.parametrize("behind", [False, True])
def test_the_chunks_of_a_png_are_copied_to_the_side_they_were_on(tmp_path: Path, behind: bool) -> None:
    plain = encoded(picture(), "PNG")
    chunks = pack_chunk(b"eXIf", block()) + pack_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + XMP)
    chunks += pack_chunk(b"gAMA", struct.pack(">I", 45455)) + pack_chunk(b"teSt", b"a private one")
    at = plain.index(b"IEND" if behind else b"IDAT") - 4
    (tmp_path / "in.png").write_bytes(plain[:at] + chunks + plain[at:])
    again(tmp_path / "in.png", tmp_path / "out.png")

    data = (tmp_path / "out.png").read_bytes()
    assert chunks in data
    assert (data.index(chunks) > data.index(b"IDAT")) == behind
    assert read_picture(tmp_path / "out.png").shape == (3, 60, 40), "Orientation 6 lies in EXIF, on either side"


def test_unsafe_chunks_of_other_programs_are_not_copied_to_other_pixels(tmp_path: Path) -> None:
    plain = encoded(picture(), "PNG")
    at = plain.index(b"IDAT") - 4
    (tmp_path / "in.png").write_bytes(plain[:at] + pack_chunk(b"teST", b"a sum over the pixels") + plain[at:])
    again(tmp_path / "in.png", tmp_path / "out.png")
    assert b"a sum over" not in (tmp_path / "out.png").read_bytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["png", "tif", "webp"])
def test_exif_and_xmp_go_to_other_formats(tmp_path: Path, order: str, kind: str) -> None:
    exif = block(order)
    segments = (0xE1, b"Exif\0\0" + exif), (0xE1, XMP_PREFIX + XMP)
    (tmp_path / "in.jpg").write_bytes(insert(encoded(picture(), "JPEG"), *segments))
    again(tmp_path / "in.jpg", tmp_path / f"out.{kind}")
    stored = read_stored(tmp_path / f"out.{kind}")
    assert stored.metadata.xmp == XMP
    assert tags_of(stored.metadata.exif) == tags_of(exif)
    assert read_picture(tmp_path / f"out.{kind}").shape == (3, 60, 40)


def tags_of(exif: bytes | None) -> dict[tuple[int, int], bytes]:
    """The tags of a block, by directory and code, without those that say where others stand."""
    assert exif is not None
    tiff = TiffFile(BytesIO(exif))
    first = tiff.directory(tiff.first)
    directories = {0: first, **{code: tiff.directory(tiff.number(first, code)) for code in (34665, 34853)}}
    tags = {}
    for number, directory in directories.items():
        for entry in directory.entries.values():
            if entry.code not in (34665, 34853):
                tags[number, entry.code] = tiff.tag(entry).data
    return tags


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_tags_of_a_tiff_are_those_of_the_first_one(tmp_path: Path, order: str) -> None:
    (tmp_path / "a.jpg").write_bytes(insert(encoded(picture(), "JPEG"), (0xE1, b"Exif\0\0" + block(order))))
    again(tmp_path / "a.jpg", tmp_path / "a.tif")
    again(tmp_path / "a.tif", tmp_path / "b.tif")
    assert tags_of(read_stored(tmp_path / "b.tif").metadata.exif) == tags_of(block(order))
    again(tmp_path / "b.tif", tmp_path / "b.jpg")
    assert tags_of(read_stored(tmp_path / "b.jpg").metadata.exif) == tags_of(block(order))


def test_a_float_tiff_stays_one(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((8, 9, 3), np.float32)
    again(written(tmp_path / "in.tif", pixels), tmp_path / "out.tif")
    assert np.array_equal(oiio.ImageInput.open(str(tmp_path / "out.tif")).read_image("float"), pixels)


def test_a_webp_without_losses_comes_back_bit_for_bit_with_hidden_colours(tmp_path: Path) -> None:
    pixels = numbers(np.uint8, 4)
    Image.fromarray(pixels).save(tmp_path / "in.webp", lossless=True, exact=True, exif=block())
    again(tmp_path / "in.webp", tmp_path / "out.webp")
    with Image.open(tmp_path / "out.webp") as image:
        assert np.array_equal(np.asarray(image), pixels) and image.info["exif"] == block()


def test_a_tiff_of_pages_is_refused(tmp_path: Path) -> None:
    picture().save(tmp_path / "in.tif", save_all=True, append_images=[picture()])
    with pytest.raises(ValueError, match="2 pages"):
        read_stored(tmp_path / "in.tif")


def test_damaged_metadata_is_no_reason_to_refuse_a_picture(tmp_path: Path) -> None:
    damaged = b"Exif\0\0" + block()[:40]
    (tmp_path / "in.jpg").write_bytes(
        insert(encoded(picture(), "JPEG"), (0xE1, damaged), (0xE1, b"Exif\0\0II*\0\xff\xff\xff\xff"))
    )
    again(tmp_path / "in.jpg", tmp_path / "out.jpg")
    assert damaged in (tmp_path / "out.jpg").read_bytes()
    assert read_picture(tmp_path / "out.jpg").shape == (3, 40, 60)

    with pytest.warns(UserWarning, match="EXIF is damaged"):
        again(tmp_path / "in.jpg", tmp_path / "out.tif")
    assert read_picture(tmp_path / "out.tif").shape == (3, 40, 60)


def test_tags_that_overlap_do_not_fill_the_memory() -> None:
    shared = [Tag(code, 7, 2**16, b"") for code in range(60000, 62000)]
    block = bytearray(b"II*\0" + struct.pack("<I", 8) + pack_directory("<", shared, 8))
    block += bytes(2**17)
    tiff = TiffFile(BytesIO(bytes(block)))
    with pytest.raises(DamagedTags, match="bytes"):
        tiff.tags(tiff.directory(8).entries.values())
