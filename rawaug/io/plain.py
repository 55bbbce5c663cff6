"""Pictures that OpenImageIO would decode to other colours than theirs: they are refused by what their header says.

It converts CMYK without a profile, takes several channels for RGB, and ignores signs and subsampling. Source: Adobe
Photoshop file formats, "File header"; ITU-T T.800, annexes A and I.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

FLOATS = ("half", "float", "double")
"""OpenImageIO's types of floating point."""

_PSD_MODES = {4: "CMYK", 7: "multichannel", 8: "duotone", 9: "CIELAB"}
"""These modes of PSD are no RGB. OpenImageIO converts the first without its profile and takes the second for RGB."""

_ENUMERATED_SPACES = (16, 17)
"""JPEG 2000's numbers of sRGB and of grey in sRGB's transfer function."""
_JP2_SPACES = {12: "CMYK", 14: "CIELAB", 18: "sYCC"}
_MOST_OF_HEADER = 2**20


def require_plain(path: Path, name: str) -> None:
    """Raise ValueError for PAM, for PSD without RGB, and for JPEG 2000 of other colours or components.

    Args:
        path: the file.
        name: the name of its format, as in :class:`rawaug.io.content.Content`.
    """
    if name not in ("PNM", "PSD", "JPEG 2000"):
        return
    with path.open("rb") as file:
        head = file.read(_MOST_OF_HEADER)

    if name == "PNM" and head.startswith(b"P7"):
        raise ValueError(f"{path}: is PAM, which is not read; convert it to PNM or PNG (pamtopnm, ImageMagick)")
    if name == "PSD":
        mode = int.from_bytes(head[24:26], "big")
        if mode in _PSD_MODES:
            raise ValueError(f"{path}: is {_PSD_MODES[mode]} in PSD; convert it to sRGB first")
    if name == "JPEG 2000":
        _require_plain_components(path, head)


def _require_plain_components(path: Path, head: bytes) -> None:
    """Raise ValueError for JPEG 2000 whose components are signed, subsampled or unlike, a palette, or no RGB."""
    colour = head.find(b"colr")
    if colour >= 0 and head[colour + 4 : colour + 5] == b"\1":
        space = int.from_bytes(head[colour + 7 : colour + 11], "big")
        if space not in _ENUMERATED_SPACES:
            name = _JP2_SPACES.get(space, f"colour space {space}")
            raise ValueError(f"{path}: is {name} in JPEG 2000; convert it to sRGB first")

    size = head.find(b"\xff\x4f\xff\x51")
    if size < 0 or size + 42 > len(head):
        return
    count = int.from_bytes(head[size + 40 : size + 42], "big")
    components = {head[offset : offset + 3] for offset in range(size + 42, size + 42 + 3 * count, 3)}
    depths = {component[:1] for component in components}
    is_signed = any(depth >= b"\x80" for depth in depths)
    if is_signed or len(components) > 1 or not components <= {depth + b"\1\1" for depth in depths}:
        raise ValueError(f"{path}: is JPEG 2000 of signed, subsampled or unlike components; save it as PNG")
    if b"pclr" in head[:size]:
        raise ValueError(f"{path}: is JPEG 2000 with a palette; save it as PNG")


def require_grey_or_rgb(spec: Any, path: Path) -> bool:
    """Tell whether there is alpha; raise ValueError if RGB would need a profile or a choice of channels."""
    stored = spec.get_string_attribute("tiff:ColorSpace") or spec.get_string_attribute("jpeg:ColorSpace")
    if stored and any(name in stored for name in ("CMYK", "YCCK", "LAB", "separated")):
        raise ValueError(f"{path}: is {stored}; convert it to sRGB first")

    names = tuple(spec.channelnames)
    if names == ("R", "G", "B"):
        return False
    if names == ("R", "G"):  # grey with alpha in JPEG XL
        return True
    more = names[1:] if len(names) < 3 else names[3:]
    if more not in ((), ("A",)) or "A" in names[:-1]:  # a palette with alpha comes as R, A, B
        raise ValueError(f"{path}: has channels {', '.join(names)}; expected grey or R, G, B, with optional alpha")
    return bool(more)


def choose_number_type(name: str, path: Path) -> str:
    """Choose the type that numbers are read in: their own, or the next one that holds them."""
    if name in FLOATS:
        return "float"
    if name not in ("uint8", "uint16"):
        raise ValueError(f"{path}: holds {name} numbers; a picture has 8 or 16 bits, or floating point")
    return name
