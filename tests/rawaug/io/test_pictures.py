"""Pictures of every kind as sRGB, and what JPEG leaves of them."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms, ImageOps, features

from rawaug.io import decode_srgb, encode_srgb, read_picture, write_picture
from rawaug.io.directories import Tag, pack_directory
from rawaug.io.pictures import read_plane, recode_jpeg

PIXELS = np.random.default_rng(0).integers(0, 256, (24, 37, 3), np.uint8)
SRGB = torch.from_numpy(PIXELS).permute(2, 0, 1)


def write_with_oiio(path: Path, pixels: np.ndarray, kind: str) -> None:
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    assert output is not None
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()


@pytest.mark.parametrize("extension", ["png", "tif", "bmp", "ppm"])
def test_lossless_formats_give_back_every_bit(tmp_path: Path, extension: str) -> None:
    path = tmp_path / f"picture.{extension}"
    write_picture(path, SRGB)
    picture = read_picture(path)
    assert picture.dtype == torch.uint8 and torch.equal(picture, SRGB)


@pytest.mark.parametrize("extension", ["jpg", "webp"])
def test_lossy_formats_are_close(tmp_path: Path, extension: str) -> None:
    smooth = torch.linspace(0, 255, 64).expand(3, 48, 64).round().to(torch.uint8)
    write_picture(tmp_path / f"picture.{extension}", smooth)
    assert (read_picture(tmp_path / f"picture.{extension}").int() - smooth.int()).abs().max() <= 4


def test_16_bits_become_8_by_rounding(tmp_path: Path) -> None:
    numbers = np.arange(65536, dtype=np.uint16).reshape(256, 256, 1).repeat(3, -1)
    write_with_oiio(tmp_path / "a.png", numbers, "uint16")
    expected = np.rint(numbers[..., 0] / 257).astype(int)
    assert np.array_equal(read_picture(tmp_path / "a.png")[1].numpy(), expected)


def test_floats_become_the_nearest_level_and_linear_ones_go_through_the_srgb_transfer(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", SRGB.double() / 255 + 0.4 / 255 * (SRGB < 255))
    write_with_oiio(tmp_path / "a.tif", (PIXELS / 255).astype(np.float32), "float")
    linear = decode_srgb(SRGB.double() / 255).permute(1, 2, 0).float().contiguous().numpy()
    write_with_oiio(tmp_path / "a.exr", linear, "float")
    for name in ("a.png", "a.tif", "a.exr"):
        assert torch.equal(read_picture(tmp_path / name), SRGB)


def test_values_outside_the_unit_range_are_refused(tmp_path: Path) -> None:
    write_with_oiio(tmp_path / "bright.exr", np.full((4, 4, 3), 1.7, np.float32), "float")
    with pytest.raises(ValueError, match=r"bright\.exr:"):
        read_picture(tmp_path / "bright.exr")
    with pytest.raises(ValueError, match="expected"):
        write_picture(tmp_path / "nan.png", torch.full((3, 4, 4), float("nan")))


def test_grey_becomes_three_channels_and_alpha_shows_black(tmp_path: Path) -> None:
    Image.fromarray(PIXELS[..., 0]).save(tmp_path / "grey.png")
    assert torch.equal(read_picture(tmp_path / "grey.png"), SRGB[:1].expand(3, -1, -1))
    Image.fromarray(PIXELS[..., 0]).convert("LA").save(tmp_path / "grey_alpha.png")
    assert torch.equal(read_picture(tmp_path / "grey_alpha.png"), SRGB[:1].expand(3, -1, -1))
    alpha = np.full((*PIXELS.shape[:2], 1), 51, np.uint8)  # 0.2
    Image.fromarray(np.dstack([PIXELS, alpha])).save(tmp_path / "rgba.png")
    assert (read_picture(tmp_path / "rgba.png").float() - 0.2 * SRGB).abs().max() <= 1


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_respected(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(PIXELS).save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    assert np.array_equal(read_picture(tmp_path / "turned.png").permute(1, 2, 0).numpy(), upright)


@pytest.mark.parametrize("extension", ["gif", "webp"])
@pytest.mark.parametrize("settings", [{}, {"duration": 100}], ids=["frames", "timed"])
def test_animations_are_refused_and_stills_are_not(tmp_path: Path, extension: str, settings: dict[str, Any]) -> None:
    frames = [Image.fromarray(np.roll(PIXELS, k, 1)) for k in range(3)]
    frames[0].save(tmp_path / f"still.{extension}")
    assert read_picture(tmp_path / f"still.{extension}").shape == SRGB.shape
    frames[0].save(tmp_path / f"moves.{extension}", save_all=True, append_images=frames[1:], **settings)
    with pytest.raises(ValueError, match=rf"moves\.{extension}.*animation"):
        read_picture(tmp_path / f"moves.{extension}")


def test_more_pixels_than_the_limit_are_refused_by_the_header(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", SRGB)
    assert read_picture(tmp_path / "a.png", max_pixels=24 * 37).shape == SRGB.shape
    with pytest.raises(ValueError, match=r"a\.png: .*declares"):
        read_picture(tmp_path / "a.png", max_pixels=24 * 37 - 1)
    write_with_oiio(tmp_path / "layers.tif", np.zeros((20, 20, 5), np.uint8), "uint8")
    with pytest.raises(ValueError, match="declares"):
        read_picture(tmp_path / "layers.tif", max_pixels=450)
    with pytest.raises(ValueError, match=r"layers\.tif: .*channels"):
        read_picture(tmp_path / "layers.tif")


def s15_fixed16(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def icc_profile(space: bytes, tags: dict[bytes, bytes]) -> bytes:
    """A display profile of version 2; a description that does not say sRGB is added."""
    text = b"other space\0"
    tags = {b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78), **tags}
    data, table = b"", b""
    for name, tag in tags.items():
        table += name + struct.pack(">II", 128 + 4 + 12 * len(tags) + len(data), len(tag))
        data += tag + bytes(-len(tag) % 4)
    size = 128 + 4 + len(table) + len(data)
    header = struct.pack(">I4sI4s4s4s", size, b"test", 0x02400000, b"mntr", space, b"XYZ ")
    header = header.ljust(36, b"\0") + b"acsp"
    header = header.ljust(68, b"\0") + s15_fixed16(0.9642, 1, 0.8249)
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


def curve(gamma: float) -> bytes:
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * gamma)) + bytes(2)


def test_a_profile_is_applied_and_srgb_by_name_is_left_alone(tmp_path: Path) -> None:
    """In a space whose red is sRGB's green and the other way round, the two channels change places."""
    red, green, blue = ((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141))
    primaries = {b"rXYZ": green, b"gXYZ": red, b"bXYZ": blue, b"wtpt": (0.9642, 1, 0.8249)}
    tags = {name: b"XYZ " + bytes(4) + s15_fixed16(*xyz) for name, xyz in primaries.items()}
    profile = icc_profile(b"RGB ", {**tags, **{name: curve(2.2) for name in (b"rTRC", b"gTRC", b"bTRC")}})
    bright = np.clip(PIXELS, 64, 255)  # above the straight part of sRGB's curve
    for extension in ("png", "tif"):
        Image.fromarray(bright).save(tmp_path / f"a.{extension}", icc_profile=profile)
        expected = torch.from_numpy(bright[..., [1, 0, 2]].astype(int)).permute(2, 0, 1)
        assert (read_picture(tmp_path / f"a.{extension}").int() - expected).abs().max() <= 3
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(PIXELS).save(tmp_path / "srgb.png", icc_profile=srgb)
    assert torch.equal(read_picture(tmp_path / "srgb.png"), SRGB)


def test_a_grey_profile_is_applied(tmp_path: Path) -> None:
    white = b"XYZ " + bytes(4) + s15_fixed16(0.9642, 1, 0.8249)
    profile = icc_profile(b"GRAY", {b"wtpt": white, b"kTRC": curve(1.0)})
    Image.fromarray(PIXELS[..., 0]).save(tmp_path / "grey.png", icc_profile=profile)
    expected = encode_srgb(SRGB[:1].double() / 255) * 255
    error = (read_picture(tmp_path / "grey.png") - expected).abs()  # LittleCMS is coarse near black
    assert error[SRGB[:1].expand_as(error) >= 12].max() <= 2


def test_a_damaged_profile_is_reported(tmp_path: Path) -> None:
    profile = bytearray(icc_profile(b"RGB ", {b"wtpt": b"XYZ " + bytes(4) + s15_fixed16(0.9642, 1, 0.8249)}))
    Image.fromarray(PIXELS).save(tmp_path / "a.tif", icc_profile=bytes(profile))
    with pytest.raises(ValueError, match=r"a\.tif: .*profile"):
        read_picture(tmp_path / "a.tif")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_plane_is_read_as_stored(tmp_path: Path, kind: type[np.unsignedinteger]) -> None:
    numbers = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (6, 9), kind)
    Image.fromarray(numbers).save(tmp_path / "a.png")
    plane = read_plane(tmp_path / "a.png")
    assert plane.dtype == kind and np.array_equal(plane, numbers)
    write_picture(tmp_path / "rgb.png", SRGB)
    with pytest.raises(ValueError, match=r"rgb\.png: .*channels"):
        read_plane(tmp_path / "rgb.png")


@pytest.mark.parametrize("extension", ["png", "jpg"])
@pytest.mark.parametrize("share", [0, 0.5])
def test_cut_short_is_one_line_that_names_the_file(tmp_path: Path, extension: str, share: float) -> None:
    path = tmp_path / f"cut.{extension}"
    write_picture(path, SRGB)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(OSError, match=rf"cut\.{extension}") as caught:
        read_picture(path)
    assert "\n" not in str(caught.value)


def test_missing_files_and_unwritable_ones_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.png:"):
        read_picture(tmp_path / "none.png")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match=r"file"):
        write_picture(tmp_path / "file" / "a.png", SRGB)
    with pytest.raises(ValueError, match=r"a\.xyz: unsupported extension"):
        write_picture(tmp_path / "a.xyz", SRGB)
    with pytest.raises(ValueError, match=r"shape \(3, H, W\), got \(1, 24, 37\)"):
        write_picture(tmp_path / "a.png", SRGB[:1])


@given(st.floats(0, 1))
def test_the_srgb_transfer_is_inverted_and_continuous(value: float) -> None:
    v = torch.tensor(value, dtype=torch.float64)
    assert abs(decode_srgb(encode_srgb(v)) - v) < 1e-6
    assert abs(encode_srgb(decode_srgb(v)) - v) < 1e-6


def test_the_srgb_transfer_has_its_published_values() -> None:
    assert encode_srgb(torch.tensor(0.18)).item() == pytest.approx(0.4613561, abs=1e-6)
    assert decode_srgb(torch.tensor([0.0, 0.5, 1.0])).tolist() == pytest.approx([0, 0.2140411, 1], abs=1e-6)


def test_it_is_what_a_file_of_that_quality_holds_with_colour_at_half_the_width() -> None:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 6, 8, generator=generator)
    picture = (255 * torch.nn.functional.interpolate(coarse, (48, 64), mode="bilinear")[0]).to(torch.uint8)
    expected = io.BytesIO()
    Image.fromarray(picture.permute(1, 2, 0).numpy()).save(expected, "JPEG", quality=90, subsampling="4:2:2")
    assert np.array_equal(recode_jpeg(picture, 90).permute(1, 2, 0).numpy(), np.array(Image.open(expected)))
    errors = [(recode_jpeg(picture, quality).float() - picture).square().mean() for quality in (30, 90)]
    assert errors[0] > errors[1] > 0
    stripes = torch.tensor([[255, 0], [0, 0], [0, 255]], dtype=torch.uint8)[:, None].repeat(1, 32, 16)
    fine, turned = (recode_jpeg(x, 90).float() - x for x in (stripes, stripes.mT))
    assert fine.square().mean() > 2 * turned.square().mean(), "columns of colour are lost, rows are not"


def test_a_decoder_s_message_that_is_no_text_is_refused_like_any_other(tmp_path: Path) -> None:
    write_with_oiio(tmp_path / "a.exr", np.zeros((8, 8, 3), np.float32), "float")
    damaged = (tmp_path / "a.exr").read_bytes().replace(b"chlist", b"\xa8" * 6, 1)
    (tmp_path / "b.exr").write_bytes(damaged)
    with pytest.raises(OSError, match=r"b\.exr: .*OpenImageIO"):
        read_picture(tmp_path / "b.exr")


# -- what phones, cameras and other programs write ---------------------------------------------------------------------


def ultra_hdr(stops: float) -> bytes:
    """A JPEG with a gain map, as phones of Android 14 write it."""
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    gains = io.BytesIO()
    Image.fromarray(np.tile(ramp[::4], (16, 1))).save(gains, "JPEG")
    base = io.BytesIO()
    Image.fromarray(np.tile(ramp[None, :, None], (64, 1, 3))).save(base, "JPEG", quality=95)
    space = 'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"'
    law = f'hdrgm:GainMapMin="0" hdrgm:GainMapMax="{stops}" hdrgm:Gamma="1" hdrgm:OffsetSDR="0.015625" '
    law += f'hdrgm:OffsetHDR="0.015625" hdrgm:HDRCapacityMin="0" hdrgm:HDRCapacityMax="{max(stops, 0.01)}"'
    second = with_xmp(gains.getvalue(), f"<rdf:Description {space} {law}/>")
    google = "http://ns.google.com/photos/1.0/container/"
    items = '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary" Item:Mime="image/jpeg"/></rdf:li>'
    items += '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="GainMap" Item:Mime="image/jpeg" '
    items += f'Item:Length="{len(second)}"/></rdf:li>'
    names = f'xmlns:Container="{google}" xmlns:Item="{google}item/" {space}'
    listing = f"<Container:Directory><rdf:Seq>{items}</rdf:Seq></Container:Directory>"
    return with_xmp(base.getvalue(), f"<rdf:Description {names}>{listing}</rdf:Description>") + second


def with_xmp(jpeg: bytes, description: str) -> bytes:
    rdf = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
    text = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{rdf}">{description}</rdf:RDF></x:xmpmeta>'
    body = b"http://ns.adobe.com/xap/1.0/\0" + text.encode()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize("stops", [0.0, 2.0])
def test_of_a_jpeg_with_a_gain_map_the_picture_is_read_that_any_viewer_shows(tmp_path: Path, stops: float) -> None:
    (tmp_path / "a.jpg").write_bytes(ultra_hdr(stops))
    source = oiio.ImageInput.open(str(tmp_path / "a.jpg"))
    assert source is not None
    if str(source.spec().format) != "half":
        pytest.skip("this OpenImageIO does not render gain maps")
    with Image.open(tmp_path / "a.jpg") as image:
        expected = np.asarray(image.convert("RGB"))
    assert np.array_equal(read_picture(tmp_path / "a.jpg").permute(1, 2, 0).numpy(), expected)


def test_a_linear_profile_is_applied_to_all_16_bits(tmp_path: Path) -> None:
    """Cut to 8 bits before the profile, the shadows of a ramp would have 14 levels in place of 64."""
    linear = np.linspace(0, 0.05, 512)
    numbers = np.rint(65535 * linear).astype(np.uint16)[None, :, None].repeat(4, 0).repeat(3, -1)
    primaries = {
        b"rXYZ": (0.4361, 0.2225, 0.0139),
        b"gXYZ": (0.3851, 0.7169, 0.0971),
        b"bXYZ": (0.1431, 0.0606, 0.7141),
    }
    tags = {name: b"XYZ " + bytes(4) + s15_fixed16(*xyz) for name, xyz in primaries.items()}
    tags[b"wtpt"] = b"XYZ " + bytes(4) + s15_fixed16(0.9642, 1, 0.8249)
    profile = icc_profile(b"RGB ", tags | {name: curve(1.0) for name in (b"rTRC", b"gTRC", b"bTRC")})
    tifffile.imwrite(tmp_path / "a.tif", numbers, photometric="rgb", iccprofile=profile)
    expected = (255 * encode_srgb(torch.from_numpy(linear))).numpy()
    row = read_picture(tmp_path / "a.tif")[1, 0].numpy()
    assert np.abs(row - expected).max() <= 0.6 and len(np.unique(row)) == 64


@pytest.mark.parametrize("extension", ["png", "webp", "tif", "gif", "jxl", "bmp"])
def test_hidden_colours_are_black_in_every_format(tmp_path: Path, extension: str) -> None:
    pixels = np.zeros((64, 64, 4), np.uint8)
    pixels[..., :3] = 200, 120, 40
    pixels[16:48, 8:24, :3] = np.random.default_rng(0).integers(0, 255, (32, 16, 3))
    pixels[:, :32, 3] = 255
    path = tmp_path / f"a.{extension}"
    if extension == "jxl":
        path.write_bytes(imagecodecs.jpegxl_encode(pixels, lossless=True))
    elif extension == "gif":
        indices = np.where(pixels[..., 3] > 0, 0, 1).astype(np.uint8)
        image = Image.fromarray(indices, "P")
        image.putpalette([200, 120, 40] * 2 + [0] * 762)
        image.save(path, transparency=1)
    elif extension == "bmp":
        path.write_bytes(bitmap(pixels))
    else:
        settings: dict[str, Any] = {"lossless": True, "exact": True} if extension == "webp" else {}
        Image.fromarray(pixels).save(path, **settings)
    read = read_picture(path)
    assert read[:, 5, 5].tolist() == [200, 120, 40] and read[:, 5, 60].tolist() == [0, 0, 0]


def bitmap(pixels: np.ndarray) -> bytes:
    """A BMP of 32 bits with bit fields, of which one is alpha."""
    masks = struct.pack("<IIII", 0xFF0000, 0xFF00, 0xFF, 0xFF000000)
    header = struct.pack("<IiiHHIIiiII", 124, pixels.shape[1], pixels.shape[0], 1, 32, 3, pixels.nbytes, 0, 0, 0, 0)
    header = (header + masks).ljust(124, b"\0")
    body = pixels[::-1, :, [2, 1, 0, 3]].tobytes()
    return b"BM" + struct.pack("<IHHI", 14 + 124 + len(body), 0, 0, 14 + 124) + header + body


def test_a_bmp_of_run_lengths_and_of_bit_fields_has_its_colours(tmp_path: Path) -> None:
    palette = [(0, 0, 0), (200, 30, 10), (10, 200, 30), (30, 10, 200)]
    runs = b"".join(bytes((8, (k % 4) << 4 | (k + 1) % 4)) + b"\0\0" for k in range(4)) + b"\0\1"
    header = struct.pack("<IiiHHIIiiII", 40, 8, 4, 1, 4, 2, len(runs), 0, 0, 4, 4)
    table = b"".join(bytes((blue, green, red, 0)) for red, green, blue in palette)
    start = 14 + len(header) + len(table)
    (tmp_path / "rle.bmp").write_bytes(
        b"BM" + struct.pack("<IHHI", start + len(runs), 0, 0, start) + header + table + runs
    )
    rows = [[palette[(k + side % 2) % 4] for side in range(8)] for k in (3, 2, 1, 0)]
    assert read_picture(tmp_path / "rle.bmp").permute(1, 2, 0).tolist() == [[list(c) for c in row] for row in rows]

    numbers = (np.arange(64).reshape(8, 8) * 1023 % 65536).astype(np.uint16)  # 5, 6 and 5 bits
    header = struct.pack("<IiiHHIIiiII", 40, 8, -8, 1, 16, 3, numbers.nbytes, 0, 0, 0, 0)
    masks = struct.pack("<III", 0xF800, 0x07E0, 0x001F)
    start = 14 + len(header) + len(masks)
    data = b"BM" + struct.pack("<IHHI", start + numbers.nbytes, 0, 0, start) + header + masks + numbers.tobytes()
    (tmp_path / "fields.bmp").write_bytes(data)
    parts = np.stack([numbers >> 11, numbers >> 5 & 63, numbers & 31]) * (255 / np.array([31, 63, 31]).reshape(3, 1, 1))
    assert np.abs(read_picture(tmp_path / "fields.bmp").numpy() - parts).max() <= 1


def test_an_animated_jpeg_xl_or_png_is_refused(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (3, 32, 32, 3)).astype(np.uint8)
    (tmp_path / "moves.jxl").write_bytes(imagecodecs.jpegxl_encode(frames, lossless=True, photometric="rgb"))
    (tmp_path / "still.jxl").write_bytes(imagecodecs.jpegxl_encode(frames[0], lossless=True))
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(tmp_path / "moves.png", save_all=True, append_images=others)
    for name in ("moves.jxl", "moves.png"):
        with pytest.raises(ValueError, match="is an animation"):
            read_picture(tmp_path / name)
    assert np.array_equal(read_picture(tmp_path / "still.jxl").permute(1, 2, 0).numpy(), frames[0])


@pytest.mark.parametrize("channels", [1, 3])
def test_a_tiff_in_lossless_jpeg_of_16_bits_is_not_black(tmp_path: Path, channels: int) -> None:
    numbers = np.random.default_rng(0).integers(0, 65535, (32, 48, channels)).astype(np.uint16)
    kind = {"photometric": "rgb" if channels == 3 else "minisblack"}
    how = {"compression": "jpeg", "compressionargs": {"lossless": True, "bitspersample": 16}}
    tifffile.imwrite(tmp_path / "a.tif", numbers if channels == 3 else numbers[..., 0], **kind, **how)
    read = read_picture(tmp_path / "a.tif").permute(1, 2, 0).numpy()
    assert np.array_equal(read, np.broadcast_to(np.rint(numbers / 257), read.shape))


@pytest.mark.parametrize("turned", [False, True])
def test_heic_is_read_upright_and_close(tmp_path: Path, turned: bool) -> None:
    heif = pytest.importorskip("pillow_heif")
    smooth = np.linspace(40, 200, 64 * 96 * 3).reshape(64, 96, 3).astype(np.uint8)
    exif = Image.Exif()
    exif[274] = 6 if turned else 1
    image = heif.from_pillow(Image.fromarray(smooth))
    image.save(tmp_path / "a.jpg.heic", quality=95, exif=exif.tobytes())
    expected = np.rot90(smooth, -1) if turned else smooth
    read = read_picture(tmp_path / "a.jpg.heic").permute(1, 2, 0).numpy()
    assert read.shape == expected.shape and np.abs(read.astype(int) - expected).max() <= 6


def test_avif_is_read_upright_and_heic_without_its_decoder_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rawaug.io.decoding.reads_heic", lambda: False)
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x24ftypheic\0\0\0\0mif1MiHEMiPr")
    with pytest.raises(ValueError, match=r"a\.jpg: .*HEIC"):
        read_picture(tmp_path / "a.jpg")

    if not features.check("avif"):
        pytest.skip("this Pillow does not read AVIF")
    smooth = np.linspace(40, 200, 64 * 96 * 3).reshape(64, 96, 3).astype(np.uint8)
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(smooth).save(tmp_path / "a.avif", quality=95, exif=exif)
    read = read_picture(tmp_path / "a.avif").permute(1, 2, 0).numpy()
    assert read.shape == (96, 64, 3) and np.abs(read.astype(int) - np.rot90(smooth, -1)).max() <= 6


def test_exif_has_the_last_word_on_the_orientation(tmp_path: Path) -> None:
    stored = io.BytesIO()
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(PIXELS).save(stored, "JPEG", exif=exif)
    description = '<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="1"/>'
    (tmp_path / "a.jpg").write_bytes(with_xmp(stored.getvalue(), description))
    assert read_picture(tmp_path / "a.jpg").shape == (3, 37, 24)


@pytest.mark.parametrize("damage", ["cut", "bit"])
def test_a_damaged_png_is_one_line_and_libpng_is_silent(
    tmp_path: Path, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    write_picture(tmp_path / "a.png", SRGB)
    data = bytearray((tmp_path / "a.png").read_bytes())
    if damage == "cut":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(OSError, match=r"a\.png: .*read"):
        read_picture(tmp_path / "a.png")
    assert capfd.readouterr().err == ""


def test_a_palette_with_alpha_in_a_tiff_is_refused(tmp_path: Path) -> None:
    """OpenImageIO gives its numbers as R, A and B."""
    pixels = np.random.default_rng(0).integers(0, 256, (16, 20, 2), np.uint8).tobytes()
    shorts = {256: [20], 257: [16], 258: [8, 8], 259: [1], 262: [3], 277: [2], 278: [16], 338: [2]}
    shorts[320] = np.random.default_rng(1).integers(0, 65536, 768).tolist()
    tags = [Tag(code, 3, len(values), struct.pack(f"<{len(values)}H", *values)) for code, values in shorts.items()]
    tags += [Tag(273, 4, 1, struct.pack("<I", 8)), Tag(279, 4, 1, struct.pack("<I", len(pixels)))]
    place = 8 + len(pixels)
    data = b"II*\0" + struct.pack("<I", place) + pixels + pack_directory("<", tags, place)
    (tmp_path / "a.tif").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.tif: has channels R, A, B"):
        read_picture(tmp_path / "a.tif")
