"""The header of a JPEG XL codestream, as far as it says that a picture is an animation or CMYK.

Its fields are bits, the lowest of each byte first, and most numbers have one of four widths. Source: ISO/IEC 18181-1,
sections D.2 and D.3.
"""

from __future__ import annotations

CODESTREAM = b"\xff\x0a"
"""A codestream begins with these bytes."""

MOST_OF_CODESTREAM = 1024
"""This many bytes hold the header."""

_ALPHA, _SPOT, _BLACK, _CFA = 0, 2, 4, 5


class _Bits:
    """Bits of a codestream, the lowest of each byte first."""

    def __init__(self, data: bytes) -> None:
        self._value, self._left = int.from_bytes(data, "little"), 8 * len(data)

    def take(self, count: int) -> int:
        if count > self._left:
            raise ValueError("the codestream ends in its header")
        bits = self._value & ((1 << count) - 1)
        self._value >>= count
        self._left -= count
        return bits

    def choose(self, *widths: int) -> None:
        """Pass over a number that is written in one of four widths."""
        self.take(widths[self.take(2)])

    def number(self, *forms: tuple[int, int]) -> int:
        """Read a number that is written as one of four offsets and widths."""
        offset, width = forms[self.take(2)]
        return offset + self.take(width)


def read_codestream(data: bytes) -> tuple[bool, bool]:
    """Read whether a codestream is an animation, and whether it has a black channel, which makes it CMYK.

    Neither is known of data that are no codestream.

    Raises:
        ValueError: if the codestream ends in its header.
    """
    if not data.startswith(CODESTREAM):
        return False, False
    bits = _Bits(data[2:])
    _pass_size(bits)
    all_default = bits.take(1)
    if all_default:
        return False, False

    if bits.take(1):  # more fields
        bits.take(3)  # orientation
        if bits.take(1):
            _pass_size(bits)
        if bits.take(1):
            _pass_preview_size(bits)
        if bits.take(1):
            return True, False

    _pass_bit_depth(bits)
    bits.take(1)  # whether 16 bits are enough
    count = bits.number((0, 0), (1, 0), (2, 4), (1, 12))
    try:
        has_black = any(_extra_channel(bits) == _BLACK for _ in range(count))
    except ValueError:  # long names; the decoder knows the channels
        has_black = False
    return False, has_black


def _extra_channel(bits: _Bits) -> int:
    """Read what a further channel is."""
    if bits.take(1):  # all is as usual
        return _ALPHA
    kind = bits.number((0, 0), (1, 0), (2, 4), (18, 6))
    _pass_bit_depth(bits)
    bits.choose(0, 0, 0, 3)  # subsampling
    bits.take(8 * bits.number((0, 0), (0, 4), (16, 5), (48, 10)))  # name
    if kind == _ALPHA:
        bits.take(1)
    elif kind == _SPOT:
        bits.take(4 * 16)
    elif kind == _CFA:
        bits.choose(0, 2, 4, 8)
    return kind


def _pass_bit_depth(bits: _Bits) -> None:
    is_floating = bits.take(1)
    bits.choose(0, 0, 0, 6)
    if is_floating:
        bits.take(4)


def _pass_size(bits: _Bits) -> None:
    """Pass over height and width; the latter is left out if a ratio gives it."""
    small = bits.take(1)
    for what in ("height", "width"):
        if small:
            bits.take(5)
        else:
            bits.choose(9, 13, 18, 30)
        if what == "height" and bits.take(3):
            return


def _pass_preview_size(bits: _Bits) -> None:
    small = bits.take(1)
    for what in ("height", "width"):
        if small:
            bits.choose(0, 0, 5, 9)
        else:
            bits.choose(6, 8, 10, 12)
        if what == "height" and bits.take(3):
            return
