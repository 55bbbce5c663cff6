"""Pictures of every kind that a format can hold, generated with known colours, read here and by a second decoder.

    python -m benchmarks.matrices [--json FILE]

TIFF: photometric interpretation x bits x planes x predictor x compression x byte order, alpha, tiles, BigTIFF. PNG:
cICP, gAMA and cHRM. JPEG: Adobe RGB by EXIF, profiles. JPEG XL: encoded in other spaces by cjxl, if that is installed.
Every file is written by the few lines below, so that what is right is known and not a decoder's view.
The second decoders are tifffile (TIFF), Pillow with its colour management (PNG, JPEG) and djxl. Printed is, for each
format, how many files are read right (within 1.5 of 255; 6 for lossy ones), refused in a line, and read wrong, here and
by the second decoder; then a line for each that is read wrong here.
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
import tempfile
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import tifffile
from PIL import Image, ImageCms

from benchmarks.measure import parser
from rawaug.io import read_picture

HEIGHT, WIDTH = 24, 37
LOSSLESS, LOSSY = 1.5, 6.0

_Y, _X = np.mgrid[:HEIGHT, :WIDTH]
RAMPS = np.stack([_X / (WIDTH - 1), _Y / (HEIGHT - 1), (3 * _X + 2 * _Y) % 29 / 28], -1)
"""Colours ``(H, W, 3)`` in [0, 1] of every kind."""
SOFT = np.stack([0.2 + 0.6 * _X / 36, 0.5 + 0.3 * _Y / 23, 0.3 + 0.2 * (_X + _Y) / 59], -1)
"""Colours that every space has."""
P3 = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])
ADOBE = np.array([[0.7152, 0.2848, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0412, 0.9588]])
_CODES = {3: "H", 4: "I"}


@dataclass(frozen=True)
class TiffKind:
    """How a TIFF is written, in TIFF's numbers; ``numbers`` 1 are integers and 3 floating point."""

    photometric: int = 2
    bits: int = 8
    planes: int = 1
    predictor: int = 1
    compression: int = 1
    order: str = "<"
    numbers: int = 1
    alpha: int = 0
    tile: int = 0
    big: bool = False

    @property
    def name(self) -> str:
        values = "_".join(str(value) for value in vars(self).values())
        return values.replace("<", "II").replace(">", "MM")


def tiff_kinds() -> Iterator[TiffKind]:
    """The matrix of kinds."""
    for photometric in (0, 1, 2, 3):
        for bits in (1, 2, 4, 6, 8, 10, 12, 14, 16, 32):
            for planes in (1, 2) if photometric == 2 else (1,):
                for predictor, compression in ((1, 1), (1, 5), (1, 8), (1, 32773), (2, 5), (2, 8)):
                    for order in "<>":
                        if predictor == 1 or bits >= 8:
                            yield TiffKind(photometric, bits, planes, predictor, compression, order)
    for photometric in (0, 1, 2):
        for bits in (16, 32, 64):
            for planes in (1, 2) if photometric == 2 else (1,):
                for predictor, compression in ((1, 1), (1, 8), (3, 8)):
                    for order in "<>":
                        yield TiffKind(photometric, bits, planes, predictor, compression, order, numbers=3)
    for photometric in (0, 1, 2):
        for bits in (8, 12, 16):
            for alpha in (1, 2):
                for planes in (1, 2):
                    yield TiffKind(photometric, bits, planes, alpha=alpha)
    for photometric in (0, 1, 2, 3):
        for bits in (1, 8, 12, 16):
            yield TiffKind(photometric, bits, tile=16)
            yield TiffKind(photometric, bits, big=True)
            yield TiffKind(photometric, bits, 1, 1, 8, ">", tile=16, big=True)


def write_tiff(path: Path, kind: TiffKind) -> np.ndarray:
    """Write a TIFF, and return what it shows over black, ``(H, W, 3)`` in [0, 1]."""
    most = 2**kind.bits - 1
    tags: dict[int, tuple[int, list[int]]] = {}
    if kind.photometric == 3:
        entries = min(most + 1, 256)
        index = (_X + 3 * _Y) % entries
        palette = np.random.default_rng(0).integers(0, 65536, (3, min(most, 2**16 - 1) + 1))
        codes = index[..., None].astype(np.float64)
        shown = palette[:, index].transpose(1, 2, 0) / 65535
        tags[320] = (3, palette.ravel().tolist())
    else:
        colours = RAMPS if kind.photometric == 2 else RAMPS[..., :1]
        codes = colours if kind.numbers == 3 else np.rint(colours * most)
        shown = codes / (1 if kind.numbers == 3 else most)
        if kind.photometric == 0:
            codes = (1 if kind.numbers == 3 else most) - codes

    if kind.alpha:
        alpha = np.rint((0.25 + 0.5 * _Y / 23) * most)[..., None]
        if kind.alpha == 1:  # associated
            codes = np.rint(codes * alpha / most)
            shown = codes / most if kind.photometric else 1 - codes / most
        else:
            shown = shown * alpha / most
        codes = np.concatenate([codes, alpha], -1)
        tags[338] = (3, [kind.alpha])

    samples = codes.shape[-1]
    segments = []
    for plane in [codes] if kind.planes == 1 else np.split(codes, samples, -1):
        for block in _blocks(plane, kind.tile):
            segments.append(_encode(block, kind))

    per_sample = {258: kind.bits, 339: kind.numbers}
    single = {256: WIDTH, 257: HEIGHT, 259: kind.compression, 262: kind.photometric, 277: samples, 284: kind.planes}
    tags |= {code: (3, [value] * samples) for code, value in per_sample.items()}
    tags |= {code: (3, [value]) for code, value in single.items()}
    if kind.predictor > 1:
        tags[317] = (3, [kind.predictor])
    _pack_file(path, kind, tags, segments)
    return np.broadcast_to(shown, (HEIGHT, WIDTH, 3))


def _blocks(plane: np.ndarray, tile: int) -> Iterator[np.ndarray]:
    """Strips of 7 rows, or tiles that are filled up with zeros."""
    if not tile:
        for top in range(0, HEIGHT, 7):
            yield plane[top : top + 7]
        return
    padded = np.pad(plane, ((0, -HEIGHT % tile), (0, -WIDTH % tile), (0, 0)))
    for top in range(0, padded.shape[0], tile):
        for left in range(0, padded.shape[1], tile):
            yield padded[top : top + tile, left : left + tile]


def _encode(block: np.ndarray, kind: TiffKind) -> bytes:
    compress: dict[int, Callable[[Any], Any]] = {1: bytes, 5: imagecodecs.lzw_encode, 8: zlib.compress}
    compress[32773] = imagecodecs.packbits_encode
    if kind.numbers == 3:
        numbers = np.ascontiguousarray(block, f"{kind.order}f{kind.bits // 8}")
        data = numbers.tobytes()
        if kind.predictor == 3:
            data = imagecodecs.floatpred_encode(numbers.astype(f"<f{kind.bits // 8}"), axis=-2).tobytes()
        return bytes(compress[kind.compression](data))

    if kind.predictor == 2:
        block = np.diff(block, axis=1, prepend=0) % 2.0**kind.bits
    rows = [_pack_row(row, kind) for row in block.reshape(len(block), -1).astype(np.int64)]
    if kind.compression == 32773:  # each row by itself
        return b"".join(bytes(compress[kind.compression](row)) for row in rows)
    return bytes(compress[kind.compression](b"".join(rows)))


def _pack_row(row: np.ndarray, kind: TiffKind) -> bytes:
    if kind.bits in (8, 16, 32):
        return row.astype(f"{kind.order}u{kind.bits // 8}").tobytes()
    bits = row[:, None] >> np.arange(kind.bits - 1, -1, -1) & 1
    return np.packbits(bits.astype(np.uint8).ravel()).tobytes()


def _pack_file(path: Path, kind: TiffKind, tags: dict[int, tuple[int, list[int]]], segments: list[bytes]) -> None:
    start = 16 if kind.big else 8
    data, places = b"", []
    for segment in segments:
        places.append(start + len(data))
        data += segment + bytes(len(segment) % 2)
    sizes = [len(segment) for segment in segments]
    if kind.tile:
        tags |= {322: (3, [kind.tile]), 323: (3, [kind.tile]), 324: (4, places), 325: (4, sizes)}
    else:
        tags |= {273: (4, places), 278: (3, [7]), 279: (4, sizes)}

    place, inside, counter = start + len(data), 4, "I"
    table = struct.pack(kind.order + "H", len(tags))
    head = struct.pack(kind.order + "HI", 42, place)
    if kind.big:
        inside, counter = 8, "Q"
        table = struct.pack(kind.order + "Q", len(tags))
        head = struct.pack(kind.order + "HHHQ", 43, 8, 0, place)
    beyond = place + len(table) + len(tags) * (4 + 2 * inside) + inside

    values = b""
    for code, (dtype, numbers) in sorted(tags.items()):
        packed = struct.pack(f"{kind.order}{len(numbers)}{_CODES[dtype]}", *numbers)
        table += struct.pack(kind.order + "HH" + counter, code, dtype, len(numbers))
        if len(packed) <= inside:
            table += packed.ljust(inside, b"\0")
        else:
            table += struct.pack(kind.order + counter, beyond + len(values))
            values += packed + bytes(len(packed) % 2)
    byte_order = b"II" if kind.order == "<" else b"MM"
    path.write_bytes(byte_order + head + data + table + bytes(inside) + values)


# -- spaces ------------------------------------------------------------------------------------------------------------


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _encode_srgb(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def write_pngs(folder: Path) -> Iterator[Path]:
    """PNGs of 8 and 16 bits whose numbers are in a space that a chunk states; all show :data:`SOFT`."""
    light = _linear(SOFT)
    p3 = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    spaces = {
        "cicp_srgb": (SOFT, [(b"cICP", bytes((1, 13, 0, 1)))]),
        "cicp_p3": (_encode_srgb(light @ P3.T), [(b"cICP", bytes((12, 13, 0, 1)))]),
        "cicp_p3_before_srgb": (_encode_srgb(light @ P3.T), [(b"cICP", bytes((12, 13, 0, 1))), (b"sRGB", b"\0")]),
        "cicp_linear": (light, [(b"cICP", bytes((1, 8, 0, 1)))]),
        "gama_18": (light ** (1 / 1.8), [(b"gAMA", struct.pack(">I", 55556))]),
        "gama_22": (SOFT, [(b"gAMA", struct.pack(">I", 45455))]),
        "gama_chrm_p3": (light @ P3.T, [(b"gAMA", struct.pack(">I", 100000)), (b"cHRM", p3)]),
        "srgb_before_gama": (SOFT, [(b"sRGB", b"\0"), (b"gAMA", struct.pack(">I", 100000))]),
    }
    for name, (values, chunks) in spaces.items():
        for bits, dtype in ((8, ">u1"), (16, ">u2")):
            if bits == 8 and name in ("cicp_linear", "gama_chrm_p3"):  # linear light in 8 bits is coarse
                continue
            rows = np.rint(values * (2**bits - 1)).astype(dtype)
            pixels = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
            header = struct.pack(">IIBBBBB", WIDTH, HEIGHT, bits, 2, 0, 0, 0)
            parts = [(b"IHDR", header), *chunks, (b"IDAT", pixels), (b"IEND", b"")]
            path = folder / f"{name}_{bits}.png"
            path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts))
            yield path


def write_jpegs(folder: Path) -> Iterator[Path]:
    """JPEGs in Adobe RGB by EXIF in both byte orders, and with a profile of it; all show :data:`SOFT`."""
    adobe = np.rint(255 * (_linear(SOFT) @ ADOBE.T) ** (256 / 563)).astype(np.uint8)
    settings: dict[str, Any] = {"quality": 98, "subsampling": 0}
    for order, head in (("<", b"II*\0"), (">", b"MM\0*")):
        pointer, number = (struct.Struct(order + form) for form in ("HHII", "HHIHH"))
        exif = head + struct.pack(order + "IH", 8, 1) + pointer.pack(0x8769, 4, 1, 26) + bytes(4)
        exif += struct.pack(order + "H", 2) + number.pack(0xA001, 3, 1, 65535, 0) + pointer.pack(0xA005, 4, 1, 56)
        exif += bytes(4) + struct.pack(order + "H", 1) + struct.pack(order + "HHI4s", 1, 2, 4, b"R03\0") + bytes(4)
        path = folder / f"r03_{head[:2].decode()}.jpg"
        Image.fromarray(adobe).save(path, exif=b"Exif\0\0" + exif, **settings)
        yield path

    corners = [0.64, 0.33, 1.0, 0.21, 0.71, 1.0, 0.15, 0.06, 1.0]
    profile = imagecodecs.cms_profile("rgb", whitepoint=(0.3127, 0.329, 1.0), primaries=corners, gamma=563 / 256)
    Image.fromarray(adobe).save(folder / "profile.jpg", icc_profile=bytes(profile), **settings)
    yield folder / "profile.jpg"


def write_jpeg_xl(folder: Path) -> Iterator[Path]:
    """JPEG XL by cjxl in other spaces, lossy, so that djxl converts them to sRGB; there are none without it."""
    if shutil.which("cjxl") is None:
        return
    pale = 0.5 + 0.3 * (SOFT - 0.5)  # which sRGB has, whatever the space is
    Image.fromarray(np.rint(255 * pale).astype(np.uint8)).save(folder / "source.png")
    for space in ("RGB_D65_SRG_Rel_SRG", "RGB_D65_DCI_Rel_SRG", "RGB_D65_202_Rel_SRG", "RGB_D65_SRG_Rel_g0.5",
                  "RGB_D65_SRG_Rel_709", "RGB_D65_SRG_Rel_Lin"):  # fmt: skip
        path = folder / f"{space}.jxl"
        command = ["cjxl", "-d", "0.3", "-x", f"color_space={space}", str(folder / "source.png"), str(path)]
        subprocess.run(command, check=True, capture_output=True)
        yield path


# -- second decoders ---------------------------------------------------------------------------------------------------


def read_with_pillow(path: Path) -> np.ndarray:
    """A picture by Pillow, which applies profiles and nothing else."""
    with Image.open(path) as image:
        profile = image.info.get("icc_profile")
        picture = image.convert("RGB")
    if profile:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        converted = ImageCms.profileToProfile(picture, source, ImageCms.createProfile("sRGB"))
        picture = converted if converted is not None else picture
    return np.asarray(picture, np.float64)


def read_with_djxl(path: Path) -> np.ndarray:
    out = path.with_suffix(".djxl.png")
    command = ["djxl", str(path), str(out), "--color_space=RGB_D65_SRG_Rel_SRG"]
    subprocess.run(command, check=True, capture_output=True)
    return read_with_pillow(out)


def read_with_tifffile(path: Path) -> np.ndarray:
    """A TIFF by tifffile, which unpacks numbers and does not interpret them: grey and RGB alone are scaled."""
    with warnings.catch_warnings(), tifffile.TiffFile(path) as tiff:
        warnings.simplefilter("ignore")
        page = tiff.pages.first
        if page.photometric not in (1, 2) or page.extrasamples:
            raise ValueError("is not interpreted")
        numbers = page.asarray().astype(np.float64)
        scale = 255.0 if page.sampleformat == 3 else 255.0 / (2**page.bitspersample - 1)
        if page.planarconfig == 2 and page.samplesperpixel > 1:
            numbers = np.moveaxis(numbers, 0, -1)
    return np.broadcast_to(numbers.reshape(HEIGHT, WIDTH, -1) * scale, (HEIGHT, WIDTH, 3))


# -- the comparison ----------------------------------------------------------------------------------------------------


def read_here(path: Path) -> np.ndarray:
    return read_picture(path).permute(1, 2, 0).numpy().astype(np.float64)


def outcome(read: Callable[[Path], np.ndarray], path: Path, shown: np.ndarray, tolerance: float) -> tuple[str, str]:
    """``"right"``, ``"refused"`` or ``"wrong"``, and the largest error or the reason."""
    try:
        pixels = read(path)
    except Exception as error:  # every decoder has errors of its own
        return "refused", " ".join(str(error).split())
    if pixels.shape != shown.shape:
        return "wrong", f"shape {pixels.shape}"
    largest = float(np.abs(pixels - 255 * shown).max())
    return ("right" if largest <= tolerance else "wrong"), f"largest error {largest:.1f} of 255"


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("--json", type=Path, help="write all outcomes to this file")
    args = options.parse_args(arguments)

    results = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files: list[tuple[str, Path, np.ndarray, Callable[[Path], np.ndarray], float]] = []
        for kind in tiff_kinds():
            path = folder / f"{kind.name}.tif"
            files.append(("TIFF", path, write_tiff(path, kind), read_with_tifffile, LOSSLESS))
        files += [("PNG", path, SOFT, read_with_pillow, LOSSLESS) for path in write_pngs(folder)]
        files += [("JPEG", path, SOFT, read_with_pillow, LOSSY) for path in write_jpegs(folder)]
        files += [("JPEG XL", path, SOFT, read_with_djxl, LOSSY) for path in write_jpeg_xl(folder)]

        for form, path, shown, second, tolerance in files:
            if form == "JPEG XL":  # the numbers were taken to be in the other space
                shown = read_with_djxl(path) / 255
            here, reason = outcome(read_here, path, shown, tolerance)
            there, _ = outcome(second, path, shown, tolerance)
            results.append({"format": form, "file": path.name, "here": here, "second": there, "reason": reason})

    for form in dict.fromkeys(result["format"] for result in results):
        rows = [result for result in results if result["format"] == form]
        ours, theirs = (dict(Counter(row[side] for row in rows)) for side in ("here", "second"))
        print(f"{form}: {len(rows)} files; here {ours}; second decoder {theirs}")
    for result in results:
        if result["here"] == "wrong":
            print(f"wrong: {result['file']}: {result['reason']}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
