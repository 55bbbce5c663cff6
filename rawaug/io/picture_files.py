"""Picture files to and from a denoiser: the pixels as they are stored, and all else that the file says of them.

The picture is neither turned nor converted: its EXIF, its ICC profile and its orientation go to the new file as they
are, and so does transparency. 8 and 16 bits are kept where the new format has them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug.files import replacing
from rawaug.io.pictures import MAX_PIXELS, decode_file, require_srgb, require_written

QUALITY = 97
"""Of a JPEG that is written, with chroma at full size."""
PICTURE_FORMATS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
"""Extensions of the files that are read and written here."""


class StoredPicture(NamedTuple):
    """A picture as its file has it.

    Args:
        srgb: float32 ``(3, H, W)`` in [0, 1], display values, not turned upright; grey has three equal channels.
        channels: of the file, 1 to 4.
        spec: OpenImageIO's description of the file, with its metadata.
        alpha: uint8 or uint16 ``(H, W, 1)``, where there is transparency.
    """

    srgb: Tensor
    channels: int
    spec: Any
    alpha: np.ndarray | None


def read_stored(path: str | Path, max_pixels: int = MAX_PIXELS) -> StoredPicture:
    """A picture of 8 or 16 bits.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if it is not a picture, or is truncated.
        ValueError: if it is larger than ``max_pixels``, animated, CMYK or CIELAB, or holds floating-point numbers.
    """
    path = Path(path)

    def kind(spec: Any) -> Any:
        require_srgb(spec, path)
        if str(spec.format) not in ("uint8", "uint16"):
            raise ValueError(f"{path}: holds {spec.format} numbers; a picture to denoise has 8 or 16 bits")
        return spec.format

    pixels, spec = decode_file(path, max_pixels, kind)
    channels = pixels.shape[-1]
    alpha = pixels[..., -1:] if channels in (2, 4) else None
    colours = pixels[..., :3] if channels > 2 else np.repeat(pixels[..., :1], 3, axis=-1)
    scale = np.float32(1.0 / np.iinfo(pixels.dtype).max)
    srgb = torch.from_numpy(np.ascontiguousarray(colours.transpose(2, 0, 1)).astype(np.float32) * scale)
    return StoredPicture(srgb, channels, spec, alpha)


def write_stored(path: str | Path, srgb: Tensor, like: StoredPicture) -> None:
    """Write sRGB ``(3, H, W)`` in [0, 1] with the channels, bits and metadata of ``like``, whole or not at all.

    Raises:
        ValueError: if the extension is none of :data:`PICTURE_FORMATS`.
        OSError: if the file cannot be written.
    """
    import OpenImageIO as oiio

    path = Path(path)
    if path.suffix.lower() not in PICTURE_FORMATS:
        raise ValueError(f"{path}: cannot be written; use one of {', '.join(PICTURE_FORMATS)}")
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    stored = np.dtype(np.uint8) if jpeg else np.dtype(str(like.spec.format))
    most = np.iinfo(stored).max
    colours = srgb if like.channels > 2 else srgb.mean(0, keepdim=True)
    pixels = (colours.clamp(0.0, 1.0) * most).round().permute(1, 2, 0).numpy().astype(stored)
    if like.alpha is not None and not jpeg:
        pixels = np.concatenate([pixels, like.alpha], axis=-1)
    spec = oiio.ImageSpec(like.spec)
    spec.set_format(str(stored))
    spec.nchannels, spec.channelnames = pixels.shape[-1], list(like.spec.channelnames)[: pixels.shape[-1]]
    if jpeg:
        spec.attribute("Compression", f"jpeg:{QUALITY}")
        spec.attribute("jpeg:subsampling", "4:4:4")
    with replacing(path) as partial:
        output = oiio.ImageOutput.create(str(path))
        written = output.open(str(partial), spec) and output.write_image(np.ascontiguousarray(pixels))  # type: ignore[union-attr]
        require_written(output, written, path)
