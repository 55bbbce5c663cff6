"""The compiled pass against the one in PyTorch: the same numbers, on any number of threads, from any picture."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rawaug.kernels import cpu
from rawaug.kernels.reference import Unprocessing, apply_curves, blur_taps, mask_frame, unprocess

NODES = 9


def camera(
    batch: int, attention: bool, shading: bool, seed: int = 0, entries: int = 0, blurs: bool = False
) -> Unprocessing:
    generator = torch.Generator().manual_seed(seed)
    table = torch.rand(NODES, NODES, NODES, 4, generator=generator)
    frames = [mask_frame([2 * k, 4, 200, 300, k], 10, 12, (0.1, -0.05)) for k in range(batch)]
    return Unprocessing(
        table=torch.empty(0, 0, 0, 4) if entries else table,
        curves=torch.rand(batch, entries, generator=generator).sort(dim=1).values,
        attention=2.0 * table.flip(0) if attention else torch.empty(0, 0, 0, 4),
        colour=torch.rand(batch, 6, 3, generator=generator),
        knee=0.9,
        frame=torch.tensor(frames).reshape(batch, 6),
        shading=torch.tensor([0.9, 0.4, 0.7]) if shading else torch.empty(0),
        sites=((1, 0, 0), (1, 1, 1), (0, 0, 1), (0, 1, 2)),
        taps=blur_taps(torch.linspace(0.0, 1.0, batch)) if blurs else torch.empty(batch, 0),
    )


def pictures(*shape: int) -> Tensor:
    return torch.randint(256, shape, generator=torch.Generator().manual_seed(1), dtype=torch.uint8)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("attention", [False, True])
@pytest.mark.parametrize("shading", [False, True])
@pytest.mark.parametrize("white", [1.0, 0.2, float("inf")])
def test_compiled_is_the_same_pass(attention: bool, shading: bool, white: float) -> None:
    srgb, setting = pictures(3, 3, 6, 1100), camera(3, attention, shading)
    for x in (srgb, srgb / 255.0) if attention and shading else (srgb,):  # each compiles code of its own
        torch.testing.assert_close(cpu.unprocess(x, setting, white), unprocess(x, setting, white), atol=1e-4, rtol=0)


@pytest.mark.parametrize("entries", [0, 256])
@pytest.mark.parametrize("size", [(2, 2), (4, 6), (34, 512), (40, 1100)])
def test_blurred_light_is_the_same_pass_with_any_number_of_threads(
    entries: int, size: tuple[int, int], threads: None
) -> None:
    srgb, setting = pictures(3, 3, *size), camera(3, False, False, entries=entries, blurs=True)
    torch.set_num_threads(1)
    raw = cpu.unprocess(srgb, setting, 0.9)
    torch.testing.assert_close(raw, unprocess(srgb, setting, 0.9, band=8 * size[1]), atol=1e-4, rtol=0)
    assert not torch.equal(raw, cpu.unprocess(srgb, setting._replace(taps=torch.empty(3, 0)), 0.9))
    torch.set_num_threads(3)
    assert torch.equal(raw, cpu.unprocess(srgb, setting, 0.9))


@pytest.mark.parametrize("entries", [256, 1021])
@pytest.mark.parametrize("all_stages", [False, True])
def test_curves_by_picture_are_the_same_pass(entries: int, all_stages: bool) -> None:
    srgb, setting = pictures(3, 3, 6, 1100), camera(3, all_stages, all_stages, entries=entries)
    for x in (srgb, srgb / 255.0) if all_stages else (srgb,):
        expected = unprocess(x, setting, 0.9)
        torch.testing.assert_close(cpu.unprocess(x, setting, 0.9), expected, atol=1e-5, rtol=0)
        assert torch.equal(cpu.unprocess(x[1:2], one_of(setting, 1), 0.9)[0], cpu.unprocess(x, setting, 0.9)[1])


def test_a_curve_has_every_code_of_a_byte() -> None:
    curve = torch.linspace(0.0, 1.0, 1021)[None] ** 2
    codes = torch.arange(256, dtype=torch.uint8).reshape(1, 1, 16, 16)
    torch.testing.assert_close(apply_curves(curve[:, ::4], codes).flatten(), curve[0, ::4], atol=0, rtol=0)
    torch.testing.assert_close(apply_curves(curve, codes).flatten(), curve[0, ::4])
    between = apply_curves(curve, torch.tensor([[[[0.0, 100.25 / 1020]]]]))
    torch.testing.assert_close(between.flatten()[1], curve[0, 100] + 0.25 * (curve[0, 101] - curve[0, 100]))


def test_codes_looked_up_sixty_four_at_once_are_those_looked_up_one_by_one() -> None:
    srgb, setting = pictures(2, 3, 6, 320), camera(2, False, False, entries=256)
    narrow = cpu.unprocess(srgb[..., :62].contiguous(), setting, 0.9)
    assert torch.equal(cpu.unprocess(srgb, setting, 0.9)[..., :31], narrow)


def one_of(setting: Unprocessing, picture: int) -> Unprocessing:
    own = slice(picture, picture + 1)
    return setting._replace(curves=setting.curves[own], colour=setting.colour[own], frame=setting.frame[own])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 3), st.integers(0, 9), st.integers(0, 300))
def test_any_size(batch: int, height: int, width: int) -> None:
    srgb, setting = pictures(batch, 3, 2 * height, 2 * width), camera(batch, True, True)
    torch.testing.assert_close(cpu.unprocess(srgb, setting, 1.0), unprocess(srgb, setting, 1.0), atol=1e-4, rtol=0)


def test_same_bits_on_any_number_of_threads(threads: None) -> None:
    srgb, setting = pictures(2, 3, 400, 500), camera(2, True, True)
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(cpu.unprocess(srgb, setting, 1.0))
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_floats_beyond_the_cube_are_held_to_it_and_strides_do_not_matter() -> None:
    wild = torch.tensor([-1e30, -0.5, 0.0, 0.5, 1.0, 1.5, 1e30, float("inf")]).repeat(3)[:, None].expand(1, 3, 24, 16)
    setting = camera(1, True, True)
    expected = cpu.unprocess(wild.clamp(0.0, 1.0), setting, 1.0)
    assert torch.equal(cpu.unprocess(wild, setting, 1.0), expected)
    cpu.unprocess(torch.full((1, 3, 4, 4), float("nan")), setting, 1.0)  # must not read outside the table


def test_bands_in_pytorch_are_the_picture_in_one() -> None:
    srgb, setting = pictures(2, 3, 20, 16), camera(2, True, True)
    whole = unprocess(srgb, setting, 1.0)
    torch.testing.assert_close(unprocess(srgb, setting, 1.0, band=6 * 16), whole, atol=1e-6, rtol=0)
