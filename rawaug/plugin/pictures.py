"""Pictures in any common form, converted to a single one: RGB, channels first, 8 bits or float32 in [0, 1].

A *picture* is a tensor, a NumPy array or a PIL image, HWC or CHW: uint8, uint16 (divided by 65535) or floating point
in [0, 1]. Grey is repeated to three channels. The colours of RGBA are kept as they are stored and alpha is left out. A
float tensor of four channels, or an array that has them first, is refused, as it is more likely packed RAW. A *batch*
is ``(B, 3, H, W)`` or ``(B, H, W, 3)``, or a list of pictures. A *sample*, or a loader's batch, is one of these, or a
tuple or mapping with one among its fields.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.isp.functional import as_float, require_display_range

_CHANNELS = (1, 3, 4)
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_PIL_AS_RGB = ("1", "L", "LA", "La", "P", "PA", "RGBA", "RGBa", "RGBX", "YCbCr")
_PIL_AS_IS = ("RGB", "F", "I;16", "I;16L", "I;16B", "I;16N")

_PAIR = (
    "samples begin with two pictures of one shape, as noisy and clean ones do, and the first is made RAW; "
    "give key=1 if the second is the clean one, or key=0"
)

Where = str | int | None
"""Where the picture is in a sample: a key, an index, or None if the sample is the picture."""


def to_rgb_tensor(picture: Any, bgr: bool = False) -> Tensor:
    """Convert a picture to ``(3, H, W)``, uint8 or float32.

    The axis of length 1, 3 or 4 holds the channels; if both ends qualify, it is the first axis of a tensor and the last
    of an array. 8 bits and floats keep their values. Floats may exceed [0, 1] by half an 8-bit level, as resizing
    leaves them. They are checked on the CPU only, because a check would stall other devices.

    Args:
        picture: a picture in any form that the module lists.
        bgr: whether its channels are in the order B, G, R, as ``cv2.imread`` gives them.

    Raises:
        ValueError: if it is no picture, or has values outside [0, 1].
    """
    image = _as_tensor(picture)
    if image.ndim == 2:
        image = image[None]
    if image.ndim != 3:
        raise ValueError(f"a picture must be (3, H, W), (H, W, 3), grey or RGBA, got {describe(picture)}")
    rgb = _rgb(image, picture)
    return rgb.flip(-3) if bgr else rgb


def to_rgb_batch(pictures: Any, bgr: bool = False) -> Tensor:
    """Convert a batch to ``(B, 3, H, W)``, uint8 or float32; a single picture is a batch of one."""
    if is_picture(pictures):
        return to_rgb_tensor(pictures, bgr)[None]
    if isinstance(pictures, Sequence):
        return stack_pictures([to_rgb_tensor(picture, bgr) for picture in pictures])
    image = _as_tensor(pictures)
    if image.ndim != 4:
        raise ValueError(f"a batch must be (B, 3, H, W), (B, H, W, 3) or a list, got {describe(pictures)}")
    rgb = _rgb(image, pictures)
    return rgb.flip(-3) if bgr else rgb


def stack_pictures(images: Sequence[Tensor]) -> Tensor:
    """Stack pictures ``(3, H, W)`` of one size to ``(B, 3, H, W)``; if only some are 8 bits, all become float32."""
    sizes = sorted({tuple(image.shape[-2:]) for image in images})
    if len(sizes) != 1:
        listed = ", ".join(f"{height} x {width}" for height, width in sizes) or "no pictures"
        raise ValueError(
            f"pictures of a batch must have one size, got {listed}; crop them, as wrap(..., crop=256) does"
        )

    if len({image.dtype for image in images}) > 1:
        images = [as_float(image) for image in images]
    return torch.stack(list(images))


def trim_to_even(image: Tensor) -> Tensor:
    """Drop the last row or column of ``(..., H, W)`` if a side is odd: a Bayer cell is 2 x 2."""
    height, width = image.shape[-2:]
    if min(image.shape[0], height // 2, width // 2) < 1:
        raise ValueError(f"a picture must be at least 2 x 2 and a batch must not be empty, got {tuple(image.shape)}")
    return image[..., : height - height % 2, : width - width % 2]


def is_picture(value: Any) -> bool:
    """Tell whether ``value`` is one picture: a PIL image, or a tensor or array with two or three axes."""
    if isinstance(value, (Tensor, np.ndarray)):
        return value.ndim in (2, 3)
    return hasattr(value, "getbands")


def find_picture(sample: Any, key: str | int | None, batched: bool = False) -> Where:
    """Find the picture of a sample.

    Args:
        sample: a picture, or a tuple, list or mapping that contains one.
        key: its key in a mapping, or its index in a tuple or list. The default is the first element of a tuple, with a
            warning if the second is a picture of the same shape.
        batched: whether ``sample`` is a loader's batch, in which a list of pictures is a batch of pictures.

    Returns:
        The key or index, for :func:`get_picture`; None if the sample itself is the picture.

    Raises:
        ValueError: if there is no such key or index.
    """
    if isinstance(sample, Mapping):
        if key not in sample:
            names = ", ".join(map(str, sample))
            raise ValueError(f"samples are mappings with the keys {names}; give the picture's as key=, got {key!r}")
        return key
    if isinstance(sample, (tuple, list)) and sample:
        if batched and key is None and is_picture(sample[0]):
            return None
        if key is None and len(sample) > 1 and _likely_pair(*sample[:2]):
            warn_of_pairs()
        picture_key = key or 0
        if not isinstance(picture_key, int) or not -len(sample) <= picture_key < len(sample):
            raise ValueError(f"key={key!r}: samples are tuples of {len(sample)}; give the index of the picture")
        return picture_key % len(sample)
    if key is not None:
        raise ValueError(f"key={key!r}: samples are neither mappings nor tuples but {describe(sample)}; omit key")
    return None


@cache
def warn_of_pairs() -> None:
    """Warn once per process: a warnings filter that is set anew would let the warning through at every sample."""
    warnings.warn(_PAIR, stacklevel=3)


def _likely_pair(first: Any, second: Any) -> bool:
    """Whether both are colour pictures, or batches of them, of one shape."""
    if isinstance(first, (Tensor, np.ndarray)) and isinstance(second, (Tensor, np.ndarray)):
        if first.ndim not in (3, 4) or 3 not in (first.shape[-3], first.shape[-1]):
            return False
        return tuple(first.shape) == tuple(second.shape)

    if not hasattr(first, "getbands") or not hasattr(second, "getbands"):
        return False
    return first.mode == second.mode == "RGB" and bool(first.size == second.size)


def get_picture(sample: Any, picture_key: Where) -> Any:
    """Get the picture of a sample, at the place that :func:`find_picture` has found."""
    return sample if picture_key is None else sample[picture_key]


def replace_picture(sample: Any, picture_key: Where, value: Any) -> Any:
    """Put ``value`` into a sample in place of its picture; the other fields stay, and a mapping becomes a dict.

    A dict that replaces the picture of a mapping is merged with it; ValueError if that would overwrite another field.
    """
    if picture_key is None:
        return value
    if isinstance(sample, Mapping):
        if not isinstance(value, dict):
            return {**sample, picture_key: value}
        fields_left = {name: field for name, field in sample.items() if name != picture_key}
        duplicates = sorted(map(str, fields_left.keys() & value.keys()))
        if duplicates:
            raise ValueError(f"the samples have {', '.join(duplicates)} already; give other keys=")
        return fields_left | value

    fields = list(sample)
    fields[int(picture_key)] = value
    if isinstance(sample, list):
        return fields
    if hasattr(sample, "_fields"):  # a named tuple
        return type(sample)(*fields)
    return tuple(fields)


def _as_tensor(picture: Any) -> Tensor:
    """Convert a picture to a tensor: the values as they are, in the type that PyTorch has for them."""
    if isinstance(picture, Tensor):
        if picture.layout != torch.strided:
            raise ValueError(f"a picture must be a dense tensor, got {picture.layout}; call to_dense()")
        return picture.as_subclass(Tensor)

    if hasattr(picture, "getbands"):
        if picture.mode in _PIL_AS_RGB:
            picture = picture.convert("RGB")
        elif picture.mode not in _PIL_AS_IS:
            raise ValueError(f"a PIL image of mode {picture.mode!r} is not sRGB; convert it to RGB first")
    if isinstance(picture, (str, Path)):
        raise ValueError(
            f"a picture must be read first, got the path {str(picture)!r:.100}; a folder's path is a dataset"
        )

    array = np.array(picture)
    if array.dtype.kind not in "uif" or array.dtype.itemsize > 8:
        raise ValueError(f"a picture must be a tensor, a NumPy array or a PIL image, got {describe(picture)}")
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), copy=False))


def _rgb(image: Tensor, original: Any) -> Tensor:
    """Convert ``(..., C, H, W)`` or ``(..., H, W, C)`` to ``(..., 3, H, W)``, uint8 or float32."""
    is_first = image.shape[-3] in _CHANNELS
    is_last = image.shape[-1] in _CHANNELS
    if not is_first and not is_last:
        raise ValueError(f"a picture must be (3, H, W), (H, W, 3), grey or RGBA, got {describe(original)}")
    if is_first and isinstance(original, Tensor):
        is_last = False
    if is_last:
        image = image.movedim(-1, -3)

    if image.shape[-3] == 1:
        image = image.expand(*image.shape[:-3], 3, -1, -1)
    elif image.shape[-3] == 4:
        is_rgba = is_last and isinstance(original, np.ndarray)
        if image.is_floating_point() and not is_rgba:
            raise ValueError(
                f"{describe(original)} has four channels: is this packed RAW? It needs sRGB; of RGBA pass the first "
                "three"
            )
        image = image[..., :3, :, :]

    if image.dtype == torch.uint8:
        return image
    if image.dtype == torch.uint16:
        return image.float() / 65535.0
    if image.dtype not in _FLOATS:
        raise ValueError(f"a picture must be uint8, uint16 or float in [0, 1], got {image.dtype}; convert it first")
    require_display_range(image)
    return image.float()


def describe(value: Any) -> str:
    """Describe a value for messages: its type, and the shape of a tensor or array."""
    if isinstance(value, (Tensor, np.ndarray)):
        return f"{type(value).__name__} of shape {tuple(value.shape)}, {value.dtype}"
    return type(value).__name__
