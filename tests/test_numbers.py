"""Extreme numbers, types and surroundings through the public names: the right value, or one line that says why not."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from denoisers import DnCNN
from rawaug import DictionaryISP, ISPConfig, RawAugment, RawPairs, wrap
from rawaug.metrics import patch_psnr, psnr, ssim
from rawaug.noise import EldNoise, FixedLevels, NoiseModel, PoissonGaussianNoise, SensorNoise, ShotReadNoise


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


SRGB = torch.rand(2, 3, 16, 24, generator=generator())
PACKED = torch.rand(2, 4, 12, 16, generator=generator())
AUGMENT = RawAugment(DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3)), noise=(1e-3, 1e-5))
ISP = AUGMENT.isp
PAIR = AUGMENT(SRGB, generator=generator())
LEVELS = FixedLevels(1e-3, 1e-5)
NOISES: dict[str, NoiseModel] = {
    "shot_read": ShotReadNoise(LEVELS),
    "poisson": PoissonGaussianNoise(LEVELS),
    "sensor": SensorNoise(
        LEVELS, tukey_lambda=-0.1, row_var=1e-6, black_offset_sd=1e-3, colour_bias_sd=1e-3, dead=0.01, hot=0.01, bits=12
    ),
    "eld": EldNoise("SonyA7S2"),
}
NET = DnCNN(width=4, depth=2).eval()
VARIANCE = torch.full_like(PACKED, 1e-3)


@pytest.fixture
def restored() -> Iterator[None]:
    """PyTorch's global settings, put back after the test."""
    dtype, threads = torch.get_default_dtype(), torch.get_num_threads()
    yield
    torch.set_default_dtype(dtype)
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)


def noisy_of(model: NoiseModel, clean: Tensor) -> Tensor:
    return model.apply(clean, model.sample(len(clean), generator()))


def refused(call: Callable[[], object], said: str, kind: type[Exception] = ValueError) -> None:
    with pytest.raises(kind, match=said) as caught:
        call()
    assert "\n" not in str(caught.value)


# -- pictures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("size", [(2, 2), (2, 500), (16, 16)])
def test_black_stays_black_and_white_white(dtype: torch.dtype, level: int, size: tuple[int, int]) -> None:
    white = 255 if dtype == torch.uint8 else 1
    pair = AUGMENT(torch.full((1, 3, *size), level * white, dtype=dtype), generator=generator())
    assert pair.clean.dtype == torch.float32 and pair.noisy.isfinite().all()
    assert (pair.clean - level).abs().max() < 1e-3  # an unfitted lens shades a little
    assert torch.allclose(pair.variance, 1e-3 * pair.noisy.clamp(min=0) + 1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_the_type_of_the_picture_matters_by_its_rounding_alone(dtype: torch.dtype) -> None:
    picture = SRGB.to(dtype)
    assert torch.equal(AUGMENT.apply(picture, PAIR.params).noisy, AUGMENT.apply(picture.float(), PAIR.params).noisy)
    pairs = RawPairs([picture[0]], AUGMENT, crop=8)
    assert torch.equal(pairs[0].noisy, RawPairs([picture[0].float()], AUGMENT, crop=8)[0].noisy)


LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "transposed": lambda x: x.transpose(-1, -2).contiguous().transpose(-1, -2),
    "channels last": lambda x: x.to(memory_format=torch.channels_last),
    "part of a larger one": lambda x: torch.nn.functional.pad(x, (3, 5, 1, 2))[..., 1:-2, 3:-5],
    "requires grad": lambda x: x.clone().requires_grad_(),
}


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_the_layout_of_memory_does_not_matter(layout: str) -> None:
    changed = LAYOUTS[layout](SRGB)
    noisy = AUGMENT.apply(changed, PAIR.params).noisy
    assert torch.equal(noisy, PAIR.noisy) and not noisy.requires_grad
    assert torch.allclose(ISP.reverse(changed).raw, ISP.reverse(SRGB).raw, atol=1e-6)
    for model in NOISES.values():
        assert torch.equal(noisy_of(model, LAYOUTS[layout](PACKED)), noisy_of(model, PACKED))
    with torch.no_grad():
        assert torch.allclose(NET(LAYOUTS[layout](PACKED), VARIANCE), NET(PACKED, VARIANCE), atol=1e-6)


WRONG_PICTURES = {
    "one row": (SRGB[..., :1, :], "at least 2 x 2"),
    "one column": (SRGB[..., :1], "at least 2 x 2"),
    "batch of 0": (SRGB[:0], "must not be empty"),
    "no pixels": (SRGB[..., :0, :0], "at least 2 x 2"),
    "NaN": (torch.where(SRGB.max() == SRGB, torch.nan, SRGB), "got NaN in 1 of 2304 values"),
    "infinite": (SRGB * torch.inf, "got inf to inf"),
    "negative": (-SRGB, r"must be in \[0, 1\]"),
    "8 bits as float": (SRGB * 255, r"must be in \[0, 1\]"),
    "integers": ((SRGB * 255).long(), "got torch.int64"),
    "complex": (SRGB + 0j, "got torch.complex64"),
    "8-bit float": (SRGB.to(torch.float8_e4m3fn), "got torch.float8_e4m3fn"),
    "sparse": (SRGB.to_sparse(), "dense tensor"),
    "on no device": (SRGB.to("meta"), "on meta"),
}


@pytest.mark.parametrize("name", list(WRONG_PICTURES))
def test_what_is_no_picture_is_refused_in_one_line(name: str) -> None:
    picture, said = WRONG_PICTURES[name]
    refused(lambda: AUGMENT(picture), said)
    if name != "batch of 0":  # an empty batch through the ISP alone is an empty batch
        refused(lambda: ISP.reverse(picture), r"even sides|at least|>= 2|float32|NaN|\[0, 1\]|dense|on meta")


def test_100_megapixels_are_cropped_without_a_copy() -> None:
    picture = torch.full((3, 1, 1), 128, dtype=torch.uint8).expand(3, 10_000, 10_000)
    pairs = RawPairs([picture], AUGMENT, crop=32)
    pairs.set_epoch(0)
    pair = pairs[0]
    assert pair.noisy.shape == (4, 16, 16) and pair.params.crop[2:4].tolist() == [10_000, 10_000]
    assert torch.equal(pairs.replay(0, pair.params).noisy, pair.noisy)


# -- surroundings -----------------------------------------------------------------------------------------------------


def bit_for_bit() -> bool:
    """Whether everything comes out as it did when the test module was loaded."""
    same = torch.equal(AUGMENT(SRGB, generator=generator()).noisy, PAIR.noisy)
    same &= torch.equal(RawAugment(ISP, noise=(1e-3, 1e-5))(SRGB, generator=generator()).noisy, PAIR.noisy)
    return same and all(torch.equal(noisy_of(model, PACKED), NOISY[name]) for name, model in NOISES.items())


NOISY = {name: noisy_of(model, PACKED) for name, model in NOISES.items()}


def test_inference_mode() -> None:
    with torch.inference_mode():
        assert bit_for_bit()
        pair = AUGMENT(SRGB, generator=generator())
        made_inside = RawAugment(ISP, noise=(1e-3, 1e-5))
    assert torch.equal(made_inside(SRGB, generator=generator()).noisy, PAIR.noisy)
    assert torch.equal(AUGMENT.apply(SRGB, pair.params).noisy, PAIR.noisy)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_mixed_precision_leaves_raw_float32(dtype: torch.dtype) -> None:
    raw, srgb = ISP.reverse(SRGB).raw, ISP.forward(SRGB[:, :1]).srgb
    with torch.autocast("cpu", dtype=dtype):
        assert bit_for_bit()
        assert torch.equal(ISP.reverse(SRGB).raw, raw) and torch.equal(ISP.forward(SRGB[:, :1]).srgb, srgb)
        assert NET(PACKED, VARIANCE).isfinite().all()
        assert torch.equal(psnr(PACKED, VARIANCE), psnr(PACKED, VARIANCE).float())


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_another_default_type(restored: None, dtype: torch.dtype) -> None:
    torch.set_default_dtype(dtype)
    assert bit_for_bit()
    isp = DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3))
    assert {p.dtype for p in isp.parameters()} == {torch.float32} and torch.get_default_dtype() == dtype
    refused(lambda: DnCNN(width=4, depth=2)(PACKED, VARIANCE), "noisy is torch.float32 but the network is")


def test_deterministic_algorithms(restored: None) -> None:
    torch.use_deterministic_algorithms(True)
    assert bit_for_bit()
    isp, picture = copy.deepcopy(ISP), SRGB.clone().requires_grad_()
    isp.forward(isp.reverse(picture).raw).srgb.sum().backward()
    assert picture.grad is not None and picture.grad.isfinite().all()
    assert (NET(PACKED, VARIANCE) - PACKED).isfinite().all()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["deepcopy", "pickle"])
def test_copies_do_the_same(copied: Callable[[Any], Any]) -> None:
    assert torch.equal(copied(AUGMENT)(SRGB, generator=generator()).noisy, PAIR.noisy)
    assert torch.equal(AUGMENT.apply(SRGB, copied(PAIR.params)).noisy, PAIR.noisy)
    assert torch.equal(copied(ISP).reverse(SRGB).raw, ISP.reverse(SRGB).raw)
    torch.testing.assert_close(copied(NET)(PACKED, VARIANCE), NET(PACKED, VARIANCE))
    for name, model in NOISES.items():
        assert torch.equal(noisy_of(copied(model), PACKED), NOISY[name])
    pairs, loader = RawPairs(list(SRGB), AUGMENT, crop=8), wrap([SRGB], AUGMENT)
    pairs[0]
    next(iter(loader))
    twin, other = copied(pairs), copied(loader)
    assert torch.equal(twin[0].noisy, pairs[0].noisy), "a copy goes on where the original is"
    assert torch.equal(next(iter(other)).noisy, next(iter(loader)).noisy)


@pytest.mark.parametrize("part", ["augmentation", "noise"])
def test_torch_compile_leaves_the_bits_alone(part: str) -> None:
    """With Dynamo alone: what it cannot trace, it must leave as it is."""
    pytest.importorskip("torch._dynamo")
    if part == "noise":
        apply = torch.compile(NOISES["sensor"].apply, backend="eager")
        assert torch.equal(apply(PACKED, NOISES["sensor"].sample(2, generator())), NOISY["sensor"])
    else:
        pair = torch.compile(AUGMENT, backend="eager")(SRGB, generator=generator())
        assert torch.equal(pair.noisy, PAIR.noisy)


# -- epochs and indices -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("epoch", [2**31, 2**53 + 1, 2**63 - 1])
def test_an_epoch_has_63_bits(epoch: int) -> None:
    def pairs() -> RawPairs:
        return RawPairs(list(SRGB), AUGMENT, crop=8)

    pinned, resumed, near = pairs(), pairs(), pairs()
    pinned.set_epoch(epoch)
    resumed.load_state_dict(pinned.state_dict())
    near.set_epoch(epoch - 1)
    assert torch.equal(pinned[0].noisy, resumed[0].noisy) and not torch.equal(pinned[0].noisy, near[0].noisy)
    loader = wrap([SRGB], AUGMENT)
    loader.set_epoch(epoch)
    assert next(iter(loader)).noisy.isfinite().all()


@pytest.mark.parametrize("epoch", [2**63, 2**200, -1, 1.5, "3", None])
def test_what_is_no_epoch_is_refused(epoch: Any) -> None:
    for thing in (RawPairs(list(SRGB), AUGMENT, crop=8), wrap([SRGB], AUGMENT)):
        refused(lambda thing=thing: thing.set_epoch(epoch), r"an epoch is an integer from 0 to 2\^63 - 1")  # type: ignore[misc]


# -- RAW --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(2, 2), (2, 40), (8, 8)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_raw_of_any_float_is_rendered(size: tuple[int, int], dtype: torch.dtype) -> None:
    raw = torch.rand(1, 1, *size, generator=generator()).to(dtype)
    srgb = ISP.forward(raw).srgb
    assert srgb.dtype == torch.float32 and torch.equal(srgb, ISP.forward(raw.float()).srgb)
    for level, out in ((0.0, 0.01), (1.0, 1.0), (-0.1, 0.01), (3.0, 1.0)):
        assert (ISP.forward(torch.full_like(raw, level)).srgb - out).abs().max() < 0.01


WRONG_RAW = {
    "one row": (torch.rand(1, 1, 1, 8), "even sides"),
    "no pixels": (torch.rand(1, 1, 0, 0), "at least 2 x 2"),
    "no batch": (torch.rand(1, 8, 8), r"\(B, 1, H, W\)"),
    "three colours": (torch.rand(1, 3, 8, 8), r"\(B, 1, H, W\)"),
    "digital numbers": (torch.zeros(1, 1, 8, 8, dtype=torch.uint16), "got .* torch.uint16"),
    "NaN": (torch.full((1, 1, 8, 8), torch.nan), "NaN or infinity in 64 of 64"),
}


@pytest.mark.parametrize("name", list(WRONG_RAW))
def test_what_is_no_raw_is_refused_in_one_line(name: str) -> None:
    raw, said = WRONG_RAW[name]
    refused(lambda: ISP.forward(raw), said)


@pytest.mark.parametrize("convert", ["half", "bfloat16", "double"])
def test_an_isp_of_another_type_says_so(convert: str) -> None:
    refused(lambda: getattr(copy.deepcopy(ISP), convert)().reverse(SRGB), r"call isp\.float\(\)")


# -- metrics ----------------------------------------------------------------------------------------------------------


def test_metrics_refuse_what_has_no_score() -> None:
    picture = torch.rand(1, 1, 16, 16)
    for metric in (psnr, patch_psnr, ssim):
        refused(lambda m=metric: m((picture * 255).byte(), picture), "floating point with data range 1")  # type: ignore[misc]
        refused(lambda m=metric: m(picture[..., :0], picture[..., :0]), "one or more values")  # type: ignore[misc]
        refused(lambda m=metric: m(picture, picture[..., :8]), "differ in shape")  # type: ignore[misc]
        assert metric(picture[:0], picture[:0]).shape == (0,)
        assert metric(picture * torch.nan, picture).isnan().all(), "NaN is not hidden"
    refused(lambda: ssim(picture[..., :10, :], picture[..., :10, :]), "sides of at least 11")
