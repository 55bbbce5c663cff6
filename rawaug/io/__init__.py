"""Input and output: pictures through OpenImageIO, RAW in through LibRaw, DNG out through tifffile.

None of them is loaded before a file is opened.
"""

from rawaug.io.dng import write_dng
from rawaug.io.gain_map import GainMap
from rawaug.io.pictures import decode_srgb, encode_srgb, read_picture, write_picture
from rawaug.io.raw import RawFrame, develop, read_raw, read_raw_and_develop

__all__ = [
    "GainMap", "RawFrame", "decode_srgb", "develop", "encode_srgb", "read_picture", "read_raw", "read_raw_and_develop",
    "write_dng", "write_picture",
]  # fmt: skip
