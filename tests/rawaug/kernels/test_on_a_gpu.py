"""The augmentation on a CUDA device: against PyTorch on the same device, against the CPU, and in training scripts."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rawaug import kernels
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import draw_setting
from rawaug.metrics import psnr
from rawaug.noise import FixedLevels, ShotReadNoise
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.finishing import Finish
from rawaug.plugin.jpeg import compress_jpeg
from rawaug.plugin.params import RawPair
from rawaug.plugin.targets import Burst, Srgb
from rawaug.plugin.wrapped import wrap
from tests.rawaug.kernels.full_isp import CONFIGURATIONS, full_isp

pytestmark = pytest.mark.gpu

DEVICE = "cuda"
SAME = 75.0
"""PSNR in dB from which two forms of the pass make the same RAW."""


def pictures(dtype: torch.dtype = torch.uint8, seed: int = 0) -> Tensor:
    srgb = torch.randint(256, (3, 3, 66, 130), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    return srgb if dtype == torch.uint8 else srgb / 255.0


def on_device() -> RawAugment:
    return RawAugment(full_isp(), noise="cycleisp_sidd").to(DEVICE)


def assert_same_bits(a: RawPair, b: RawPair) -> None:
    assert all(torch.equal(x, y) for x, y in zip(a[:3], b[:3], strict=True))


def test_the_kernels_are_the_ones_that_run() -> None:
    srgb = pictures().to(DEVICE)
    on_device()(srgb)
    assert kernels.can_use_triton(srgb) and not kernels._failed


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_raw_is_that_of_the_cpu_and_of_pytorch(name: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    isp, srgb = full_isp(**CONFIGURATIONS[name]), pictures(dtype)
    baked, place = BakedISP(isp), torch.tensor([[6, 34, 140, 260, 5], [0, 0, 66, 130, 0], [2, 4, 80, 140, 3]])
    params = draw_setting(isp, len(srgb), torch.Generator().manual_seed(1))
    expected = baked(srgb, params, place, white=0.3)
    baked, there, params = baked.to(DEVICE), srgb.to(DEVICE), type(params)(*(p.to(DEVICE) for p in params))
    raw = baked(there, params, place, white=0.3)
    assert raw.device.type == torch.device(DEVICE).type and raw.max() == torch.tensor(0.3)
    monkeypatch.setattr("rawaug.isp.fast.fastest", lambda *_, otherwise: otherwise())
    plain = baked(there, params, place, white=0.3)
    assert psnr(raw.cpu(), expected).min() >= SAME and psnr(raw, plain).min() >= SAME


def test_noise_is_that_of_the_cpu_and_obeys_the_law() -> None:
    model, signal = ShotReadNoise(FixedLevels(1e-3, 2e-5)), torch.tensor([0.0, 1e-3, 0.05, 0.2, 0.8])
    clean = signal[:, None, None, None].expand(-1, 4, 512, 128).contiguous()
    params = model.sample(len(clean), torch.Generator().manual_seed(0))
    noisy, variance = model.apply_with_variance(clean.to(DEVICE), params)
    for ours, expected in zip((noisy, variance), model.apply_with_variance(clean, params), strict=True):
        torch.testing.assert_close(ours.cpu(), expected, atol=2e-6, rtol=1e-5)
    noise = (noisy.cpu() - clean).double()
    assert noise.square().mean((1, 2, 3)) == pytest.approx(1e-3 * signal.double() + 2e-5, rel=0.02)
    assert noise.mean((1, 2, 3)).abs().max() < 5 * (8.2e-4 / clean[0].numel()) ** 0.5


@pytest.mark.parametrize("seed", range(8))
def test_a_seed_is_one_pair_on_both_devices(seed: int) -> None:
    srgb, cpu = pictures(seed=seed), RawAugment(full_isp(), noise="cycleisp_sidd")
    here = cpu(srgb, torch.Generator().manual_seed(seed))
    there = on_device()(srgb.to(DEVICE), torch.Generator().manual_seed(seed))
    for a, b in ((here.clean, there.clean), (here.noisy, there.noisy)):
        assert psnr(a, b.cpu()).min() >= SAME
    other = on_device()(srgb.to(DEVICE), torch.Generator().manual_seed(seed + 1))
    assert psnr(there.noisy, other.noisy).max() < 60


def test_a_replay_is_exact_alone_in_another_batch_and_from_parameters_on_the_cpu() -> None:
    augment, srgb = on_device(), pictures().to(DEVICE)
    pair = augment(srgb)
    assert_same_bits(augment.apply(srgb, pair.params), pair)
    assert_same_bits(augment.apply(srgb, pair.params.map(Tensor.cpu)), pair)
    assert_same_bits(augment.apply(srgb[1], pair.params.map(lambda t: t[1])), pair.map(lambda t: t[1]))


TARGETS: dict[str, dict[str, Any]] = {
    "raw": {},
    "rgb": {"target": "rgb"},
    "burst": {"burst": Burst(3)},
    "srgb": {"target": "srgb"},
    "finished": {"target": Srgb(finish=Finish(unfinished=0.3), shots=1)},
}


@pytest.mark.parametrize("name", TARGETS)
def test_targets_never_wait_for_the_device_and_are_those_of_the_cpu(name: str) -> None:
    augment = RawAugment.from_pretrained("universal", **TARGETS[name])
    srgb = torch.randint(256, (6, 3, 48, 66), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    expected = augment(srgb, torch.Generator().manual_seed(2))
    augment, there = augment.to(DEVICE), srgb.to(DEVICE)
    augment(there)  # compiles the kernels, and moves what is constant

    torch.cuda.set_sync_debug_mode("error")
    try:
        pair = augment(there, torch.Generator().manual_seed(2))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    least = 40 if name == "finished" else SAME  # a code that is rounded otherwise changes a block
    assert psnr(pair.noisy.cpu(), expected.noisy).min() >= least
    assert psnr(pair.clean.cpu(), expected.clean).min() >= SAME
    for k in range(len(srgb)):
        one = pair.map(itemgetter(k))
        assert_same_bits(augment.apply(there[k], one.params), one)


def test_jpeg_on_the_device_has_the_codes_of_the_cpu() -> None:
    srgb, quality = pictures().float() / 255.0, torch.tensor([30, 80, 99])
    for halved in (None, torch.tensor([True, False, True])):
        there = compress_jpeg(srgb.to(DEVICE), quality, halved)
        assert torch.equal(there.cpu(), compress_jpeg(srgb, quality, halved))


def test_raw_stays_float32_under_autocast() -> None:
    augment, srgb = on_device(), pictures().to(DEVICE)
    pair = augment(srgb)
    with torch.autocast(DEVICE, torch.bfloat16):
        again = augment.apply(srgb, pair.params)
        assert nn.Conv2d(4, 4, 3, device=DEVICE)(again.noisy).dtype == torch.bfloat16
    assert again.noisy.dtype == torch.float32
    assert_same_bits(again, pair)


@pytest.mark.filterwarnings("ignore::UserWarning:torch")  # advice of the compiler
def test_a_compiled_step_trains_on_the_same_pairs() -> None:
    augment, srgb = on_device(), pictures().to(DEVICE)
    network = nn.Conv2d(4, 4, 3, padding=1, device=DEVICE)
    params = augment(srgb).params

    def step(srgb: Tensor) -> tuple[Tensor, Tensor]:
        pair: Any = augment.apply(srgb, params)
        return pair.noisy, (network(pair.noisy) - pair.clean).square().mean()

    noisy, loss = step(srgb)
    compiled_noisy, compiled_loss = torch.compile(step)(srgb)
    compiled_loss.backward()
    assert psnr(compiled_noisy, noisy).min() >= SAME
    assert compiled_loss.item() == pytest.approx(loss.item(), rel=1e-3)
    assert network.weight.grad is not None and network.weight.grad.abs().max() > 0


def test_a_wrapped_loader_makes_its_pairs_on_the_device() -> None:
    (pair,) = wrap([pictures()], DictionaryISP(), device=DEVICE)
    assert {tensor.device.type for tensor in pair[:3]} == {torch.device(DEVICE).type}
