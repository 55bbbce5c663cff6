"""Pictures, batches and samples as people have them."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.plugin.pictures import (
    find_picture,
    get_picture,
    replace_picture,
    to_rgb_batch,
    to_rgb_tensor,
    trim_to_even,
    warn_of_pairs,
)

ARRAY = np.random.default_rng(0).integers(256, size=(6, 8, 3), dtype=np.uint8)
RGB = torch.from_numpy(ARRAY).permute(2, 0, 1)


def forms() -> dict[str, Any]:
    """The same picture in every form."""
    alpha = np.full((6, 8, 1), 7, np.uint8)
    return {
        "numpy": ARRAY,
        "numpy, mirrored twice": ARRAY[:, ::-1].copy()[:, ::-1],
        "numpy chw": ARRAY.transpose(2, 0, 1),
        "numpy rgba": np.concatenate([ARRAY, alpha], axis=2),
        "tensor": RGB,
        "tensor hwc": torch.from_numpy(ARRAY),
        "tensor rgba": torch.cat([RGB, RGB[:1]]),
        "pil": Image.fromarray(ARRAY),
        "pil rgba": Image.fromarray(np.concatenate([ARRAY, alpha], axis=2)),
    }


@pytest.mark.parametrize("form", forms())
def test_every_form_is_the_same_picture(form: str) -> None:
    assert torch.equal(to_rgb_tensor(forms()[form]), RGB)


@pytest.mark.parametrize("mode", ["L", "LA", "1", "P"])
def test_pil_modes_are_read_as_what_they_show(mode: str) -> None:
    picture = Image.fromarray(ARRAY).convert(mode)
    assert torch.equal(to_rgb_tensor(picture), torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1))


def test_pil_modes_that_are_not_srgb_are_refused() -> None:
    for mode in ("CMYK", "HSV", "LAB", "I"):
        with pytest.raises(ValueError, match=f"mode '{mode}'"):
            to_rgb_tensor(Image.new(mode, (4, 4)))


def test_packed_raw_is_not_taken_for_rgba() -> None:
    raw = torch.rand(2, 4, 8, 8)
    for packed in (raw, raw[0], raw.movedim(1, -1), raw.numpy(), raw[0].numpy(), [raw[0]]):
        with pytest.raises(ValueError, match="channels"):
            to_rgb_batch(packed)
    rgba = np.random.default_rng(0).random((6, 8, 4), dtype=np.float32)  # as matplotlib reads a PNG
    assert to_rgb_tensor(rgba).shape == (3, 6, 8)


def test_grey_is_repeated() -> None:
    for grey in (ARRAY[..., 0], ARRAY[..., :1], RGB[0], RGB[:1], Image.fromarray(ARRAY[..., 0])):
        assert torch.equal(to_rgb_tensor(grey), RGB[:1].expand(3, -1, -1))


@pytest.mark.parametrize("dtype", ["<u2", ">u2"])
def test_16_bits_are_a_65535th_each(dtype: str) -> None:
    array = np.array([[0, 1], [257, 65535]], dtype=dtype)
    expected = torch.tensor([0.0, 1 / 65535, 257 / 65535, 1.0]).reshape(1, 2, 2).expand(3, -1, -1)
    assert torch.equal(to_rgb_tensor(array), expected)
    assert torch.equal(to_rgb_tensor(Image.fromarray(array.astype("<u2"))), expected)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_float_picture_keeps_its_values(dtype: Any) -> None:
    array = np.array([[[0.25, 0.5, 1.0]]], dtype=dtype)
    out = to_rgb_tensor(array)
    assert out.dtype == torch.float32 and out.flatten().tolist() == [0.25, 0.5, 1.0]


def test_a_narrow_tensor_is_read_channels_first() -> None:
    assert to_rgb_tensor(torch.zeros(3, 8, 4)).shape == (3, 8, 4)
    assert to_rgb_tensor(np.zeros((3, 8, 4), np.uint8)).shape == (3, 3, 8)  # HWC with alpha


@pytest.mark.parametrize("bad", [np.zeros((5, 6, 7)), np.zeros((2, 3, 4, 5)), "a.png", 3, None, np.zeros((4, 4), bool)])
def test_what_is_no_picture_is_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match=r"a picture must be .*, got"):
        to_rgb_tensor(bad)
    with pytest.raises(ValueError, match="int32"):
        to_rgb_tensor(np.zeros((4, 4, 3), np.int32))


@pytest.mark.parametrize("batch", [RGB[None].expand(2, -1, -1, -1), np.stack([ARRAY, ARRAY]), [ARRAY, RGB], (RGB, RGB)])
def test_batches_of_every_form(batch: Any) -> None:
    assert torch.equal(to_rgb_batch(batch), torch.stack([RGB, RGB]))


def test_a_batch_of_8_bits_and_floats_has_one_scale() -> None:
    assert torch.equal(to_rgb_batch([RGB, RGB / 255.0]), torch.stack([RGB, RGB]) / 255.0)


def test_pictures_that_make_no_batch_are_refused() -> None:
    with pytest.raises(ValueError, match="crop"):
        to_rgb_batch([RGB, RGB.transpose(1, 2)])
    with pytest.raises(ValueError, match="no pictures"):
        to_rgb_batch([])
    with pytest.raises(ValueError, match="a batch must be"):
        to_rgb_batch(torch.zeros(1, 2, 3, 4, 4))


@pytest.mark.parametrize("shape", [(3, 1, 8), (3, 8, 0), (0, 3, 8, 8)])
def test_what_holds_no_bayer_cell_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 2 x 2"):
        trim_to_even(torch.zeros(shape))


Named = namedtuple("Named", ["image", "label"])


@pytest.mark.parametrize(
    ("sample", "key", "expected"),
    [
        (RGB, None, "new"),
        ((RGB, 3), None, ("new", 3)),
        ([RGB, 3], None, ["new", 3]),
        ((3, RGB), 1, (3, "new")),
        (Named(RGB, 3), None, Named("new", 3)),
        ({"image": RGB, "id": "x"}, "image", {"image": "new", "id": "x"}),
    ],
)
def test_the_picture_is_found_and_replaced(sample: Any, key: Any, expected: Any) -> None:
    where = find_picture(sample, key)
    assert get_picture(sample, where) is RGB
    out = replace_picture(sample, where, "new")
    assert out == expected and type(out) is type(expected)


def test_a_batch_that_is_a_list_of_pictures_is_not_taken_apart() -> None:
    assert find_picture([RGB, RGB], None, batched=True) is None
    assert find_picture([[RGB, RGB], [1, 2]], None, batched=True) == 0
    assert find_picture([RGB[None], torch.zeros(1)], None, batched=True) == 0


@pytest.mark.parametrize(
    ("sample", "key", "message"),
    [
        ({"image": RGB, "id": 1}, None, "keys image, id"),
        ({"image": RGB, "id": 1}, "picture", "got 'picture'"),
        ((RGB, 1), 2, "tuples of 2"),
        ((RGB, 1), "image", "index"),
        (RGB, "image", "omit key"),
    ],
)
def test_a_key_that_fits_nothing_says_what_would(sample: Any, key: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_picture(sample, key)


def test_noisy_and_clean_of_one_shape_are_warned_of() -> None:
    noisy, clean = torch.rand(2, 3, 20, 24)
    arrays, images = [x.numpy().transpose(1, 2, 0) for x in (noisy, clean)], [Image.new("RGB", (24, 20))] * 2
    for pair in ((noisy, clean), arrays, images, (noisy[None], clean[None])):
        warn_of_pairs.cache_clear()
        with pytest.warns(UserWarning, match="give key=1"):
            assert find_picture(pair, None) == 0
        assert find_picture(pair, None) == 0  # once is enough
    warn_of_pairs.cache_clear()
    for sample in ((noisy, clean), (noisy, clean[:, 2:]), (noisy, noisy[0]), (noisy, torch.tensor(1)), (noisy,)):
        assert find_picture(sample, 0 if sample[-1] is clean else None) == 0  # warnings are errors here
