"""Run by test_fallback.py as a script, with TRITON_INTERPRET=1: Triton's kernels step by step on the CPU."""

from __future__ import annotations

import gc
import os
from itertools import product
from typing import Any
from unittest import mock

import torch
import torch.nn.functional as F

from rawaug import bayer, kernels
from rawaug.isp.fast import BakedISP, FastForward
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import draw_setting
from rawaug.kernels import cpu, gpu, gpu_srgb, reference
from rawaug.noise.levels import FixedLevels
from rawaug.noise.models import ShotReadNoise
from tests.rawaug.kernels.full_isp import CONFIGURATIONS, full_isp

assert os.environ["TRITON_INTERPRET"] == "1"

FLOATS = ("all stages", "curves")
"""Configurations for float pictures too: a table or curves are what looks a pixel up."""


def camera_of(srgb: torch.Tensor, blur: torch.Tensor | None, **settings: Any) -> reference.Unprocessing:
    isp = full_isp(**settings)
    place = torch.tensor([[6, 34, 40, 60, 5], [0, 0, *srgb.shape[-2:], 0]])
    return BakedISP(isp)._unprocessing(srgb, isp.choose(srgb), place, blur)


def check_raw(settings: dict[str, Any], dtype: torch.dtype, blur: torch.Tensor | None = None) -> None:
    """Noisy pairs in every configuration, and the same without noise where pictures are floats."""
    srgb = torch.randint(256, (2, 3, 18, 34), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    srgb = srgb if dtype == torch.uint8 else srgb / 255.0
    camera = camera_of(srgb, blur, **settings)
    levels, keys = torch.tensor([[1e-2, 1e-3], [1e-3, 0.0]]), [2**64 - 5, 123456789012345]

    noisy, raw, variance = gpu.raw_pairs(srgb, camera, levels, keys, 0.3, False, True)
    expected = reference.unprocess(srgb, camera, 0.3)
    torch.testing.assert_close(raw, expected, atol=2e-6, rtol=1e-5)
    assert raw.max() == torch.tensor(0.3)
    for a, b in zip((noisy, variance), cpu.shot_read(raw, levels, keys, 0.3, True), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)

    again, rgb, _ = gpu.raw_pairs(srgb, camera, levels, keys, 0.3, True, False)
    assert torch.equal(again, noisy)
    torch.testing.assert_close(bayer.pack_rgb(rgb, "GBRG"), expected, atol=2e-6, rtol=1e-5)

    if dtype != torch.uint8:
        assert torch.equal(gpu.unprocess(srgb, camera, 0.3), raw)
        assert torch.equal(gpu.colours(srgb, camera, 0.3), rgb)


def check_developed(settings: dict[str, Any]) -> None:
    isp = full_isp(**settings)
    forward, params = FastForward(isp), draw_setting(isp, 4, torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(0)
    raw = F.interpolate(torch.rand(4, 1, 6, 9, generator=generator), (18, 30), mode="bicubic").mul_(0.5)
    raw += 0.02 * torch.randn(raw.shape, generator=generator)
    display, methods = forward._display(raw, params, None), torch.tensor([3, 1, 2, 0])
    ours, expected = (way.develop(raw, display, forward.cfa, methods) for way in (gpu_srgb, cpu))
    torch.testing.assert_close(ours, expected, atol=5e-6, rtol=1e-5)


def check_finishing() -> None:
    planes = torch.rand(3, 2, 13, 21, generator=torch.Generator().manual_seed(0))
    taps = torch.rand(3, 5, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(gpu_srgb.smooth(planes, taps), cpu.smooth(planes, taps), atol=1e-6, rtol=1e-5)
    mean = (planes[:, 0] - planes[:, 1]).square().mean((1, 2))
    torch.testing.assert_close(gpu_srgb.mean_square(planes), mean, atol=0, rtol=1e-5)


def check_noise(white: float) -> None:
    clean = 1.3 * torch.rand(2, 4, 12, 50, generator=torch.Generator().manual_seed(0)) - 0.1
    levels, keys = torch.tensor([[1e-2, 1e-3], [1e-3, 0.0]]), [2**64 - 5, 123456789012345]
    ours = gpu.shot_read(clean, levels, keys, white, True)
    for a, b in zip(ours, cpu.shot_read(clean, levels, keys, white, True), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)
    assert gpu.shot_read(clean, levels, keys, white, False)[1].numel() == 0


def check_kernels_are_used() -> None:
    model, clean = ShotReadNoise(FixedLevels(1e-3, 1e-5)), torch.rand(1, 4, 8, 8)
    isp, srgb = BakedISP(DictionaryISP()), torch.rand(1, 3, 16, 16)
    params, chosen = model.sample(1, torch.Generator().manual_seed(0)), isp.host.choose(srgb)
    expected = model.apply(clean, params), isp(srgb, chosen)
    asked: list[torch.Size] = []

    def usable(image: torch.Tensor) -> bool:
        asked.append(image.shape)
        return True

    with mock.patch.object(kernels, "can_use_triton", usable):
        torch.testing.assert_close(model.apply(clean, params), expected[0], atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(isp(srgb, chosen), expected[1], atol=2e-6, rtol=1e-5)
    assert set(asked) == {clean.shape, srgb.shape} and not kernels._failed


if __name__ == "__main__":
    gc.disable()  # Triton makes an object of every number
    floats = [CONFIGURATIONS[name] for name in FLOATS]
    for settings, dtype in [*product(CONFIGURATIONS.values(), [torch.uint8]), *product(floats, [torch.float32])]:
        check_raw(settings, dtype)
        print("raw")
    for name in FLOATS:
        check_raw(CONFIGURATIONS[name], torch.uint8, blur=torch.tensor([0.0, 0.8]))
        print("blurred")
    for white in (1.0, float("inf")):
        check_noise(white)
        print("noise")
    for name in FLOATS:
        check_developed(CONFIGURATIONS[name])
        print("developed")
    check_finishing()
    print("finishing")
    check_kernels_are_used()
    print("used")
