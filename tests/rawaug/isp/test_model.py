"""The dictionary ISP: shapes, sizes, conditioning, inverses and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch

from rawaug.files import WEIGHTS, read_tensors
from rawaug.isp.config import POINTWISE_STAGES, SMALL, ISPConfig
from rawaug.isp.functional import frame_coordinates
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr


@pytest.fixture
def srgb() -> torch.Tensor:
    return torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(0))


def count(isp: DictionaryISP) -> int:
    return sum(p.numel() for p in isp.parameters())


def test_sizes_stay_within_the_published_ones() -> None:
    assert 0.45e6 < count(DictionaryISP(ISPConfig(encoders=True))) <= 0.59e6
    assert count(DictionaryISP(replace(SMALL, encoders=True))) <= 0.2e6


def test_reverse_gives_a_mosaic_and_the_intermediates(srgb: torch.Tensor) -> None:
    result = DictionaryISP().reverse(srgb, intermediates=True)
    assert result.raw.shape == (2, 1, 32, 48)
    assert list(result.intermediates) == ["x1", "x2", "x3", "x4", "x5"]
    assert torch.equal(result.raw[:, 0, 0::2, 0::2], result.intermediates["x5"][:, 0, 0::2, 0::2])


def test_forward_after_reverse_above_60_db() -> None:
    isp = DictionaryISP()
    smooth = torch.linspace(0.1, 0.85, 64)[None, None, :, None].expand(1, 3, 64, 64).contiguous()
    result = isp.reverse(smooth)
    back = isp.forward(result.raw, result.params).srgb
    inner = (slice(None), slice(None), slice(4, -4), slice(4, -4))
    assert psnr(back[inner], smooth[inner]).item() > 60.0


def test_white_balance_is_taken_as_given(srgb: torch.Tensor) -> None:
    isp = DictionaryISP()
    for multipliers in ((2.0, 1.0, 1.5), (2048.0, 1024.0, 1536.0)):
        params = isp.reverse(srgb, white_balance=multipliers).params
        torch.testing.assert_close(params.gains, torch.tensor([[2.0, 1.0, 1.5]] * 2))
    params = isp.reverse(srgb, white_balance=(2.0, 1.0, 1.5), digital_gain=0.5).params
    torch.testing.assert_close(params.gains, torch.tensor([[1.0, 0.5, 0.75]] * 2))


def test_shading_depends_on_the_place_in_the_frame(srgb: torch.Tensor) -> None:
    isp = DictionaryISP()
    cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), torch.eye(2))
    centre = isp.reverse(srgb, coordinates=frame_coordinates(32, 48, (1000, 1500), (2032, 3048))).raw
    corner = isp.reverse(srgb, coordinates=frame_coordinates(32, 48, (0, 0), (2032, 3048))).raw
    assert 0.55 < (corner.mean() / centre.mean()).item() < 0.65  # exp(-1/2) at the corner


def test_stages_can_be_left_out(srgb: torch.Tensor) -> None:
    kept = tuple(stage for stage in POINTWISE_STAGES if stage != "gains")
    result = DictionaryISP(ISPConfig(stages=kept)).reverse(srgb, intermediates=True)
    assert list(result.intermediates) == ["x1", "x2", "x3", "x5"]
    with pytest.raises(ValueError, match="'bogus'"):
        DictionaryISP(ISPConfig(stages=("tone", "bogus")))


def test_what_is_off_is_neither_in_the_module_nor_in_the_file(tmp_path: Path) -> None:
    isp = DictionaryISP(ISPConfig(stages=("tone", "gamma", "colour", "gains"), attention=False))
    assert not [name for name in isp.state_dict() if "shading" in name or ("encoders" in name and "prior" not in name)]
    assert count(isp) < 6000
    isp.save(tmp_path / "camera.safetensors")
    assert (tmp_path / "camera.safetensors").stat().st_size < 40_000


def test_a_file_holds_the_whole_isp(tmp_path: Path, srgb: torch.Tensor) -> None:
    isp = DictionaryISP(ISPConfig(cfa="BGGR", colour_atoms=3, gain_atoms=5), seed=3)
    isp.info = {"frames": ["a"]}
    isp.save(tmp_path / "camera.safetensors")
    loaded = DictionaryISP.from_pretrained(tmp_path / "camera.safetensors")
    assert loaded.config == isp.config and loaded.info == isp.info
    assert torch.equal(loaded.reverse(srgb).raw, isp.reverse(srgb).raw)


def test_files_that_are_not_isps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nobody.*universal"):
        DictionaryISP.from_pretrained("nobody")
    (tmp_path / "cut.safetensors").write_bytes(b"\x00" * 20)
    with pytest.raises(ValueError, match=r"cut\.safetensors"):
        DictionaryISP.from_pretrained(tmp_path / "cut.safetensors")


def test_the_shipped_isps_are_small_and_hold_only_what_is_on() -> None:
    files = sorted(WEIGHTS.glob("*.safetensors"))
    assert len(files) == 5
    for file in files:
        has_encoders = file.stem == "phones"
        assert file.stat().st_size < (2_500_000 if has_encoders else 200_000)
        assert set(read_tensors(file, "", infinite=["colour.spread"])[1]) == set(
            DictionaryISP.from_pretrained(file).state_dict()
        )


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"colour_atoms\\": 3', '"colour_atoms\\": 9', "colour"),
        ('"gain_atoms\\": 5,', '"gain_atomz\\": 5,', r"damaged .*gain_atomz"),
        ('"cfa\\": \\"RGGB', '"cfa\\": \\"RGGG', "damaged"),
        ("stages.gamma.reverse_gamma", "stages.gamma.reverse_gumma", "stages.gamma.reverse_gamma"),
    ],
)
def test_damaged_files_are_one_line(tmp_path: Path, before: str, after: str, message: str) -> None:
    path = tmp_path / "camera.safetensors"
    DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=5, encoder_widths=(4, 4, 4))).save(path)
    content = path.read_bytes()
    assert before.encode() in content
    path.write_bytes(content.replace(before.encode(), after.encode()))
    with pytest.raises(ValueError, match=message) as caught:
        DictionaryISP.from_pretrained(path)
    assert "camera.safetensors" in str(caught.value) and "\n" not in str(caught.value)


def test_nothing_is_drawn_from_the_global_state() -> None:
    before = torch.get_rng_state()
    one, same, other = DictionaryISP(seed=1), DictionaryISP(seed=1), DictionaryISP(seed=2)
    DictionaryISP.from_pretrained("universal-small")
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), same.parameters(), strict=True))
    assert not torch.equal(one.gain.log_gains, other.gain.log_gains)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"stages": ("tone", "tone")}, "at most once"),
        ({"stages": ()}, "stages"),
        ({"encoder_widths": (8, 8)}, "must be three"),
        ({"knee": 1.0}, r"knee .*0.999"),
        ({"gain_atoms": 10**9}, r"gain_atoms .*1 to 1024"),
        ({"colour_atoms": 1e29}, r"colour_atoms .*whole"),
        ({"encoder_widths": (8, 10**6, 8)}, r"encoder_widths .*1 to 256"),
        ({"encoder_widths": 8}, r"encoder_widths .*list"),
        ({"stages": ("tone",) * 100}, "stages"),
        ({"stages": ([],)}, "stages"),
        ({"knee": float("nan")}, "knee"),
        ({"encoders": "yes"}, "encoders"),
        ({"gain_atoms": 0}, r"gain_atoms .*1 to 1024"),
    ],
)
def test_impossible_configurations_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ISPConfig(**settings)


def two_lights() -> DictionaryISP:
    """Two matrices, two gains, strong fall-off; the forward encoders take the first gains for granted."""
    isp = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2, cfa="GRBG", attention=False))
    with torch.no_grad():
        isp.colour.matrices.copy_(torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(4)) + torch.eye(3))
        isp.forward_encoders.gain.set_prior(torch.tensor([1.0, 0.0]))
        cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), 3.0 * torch.eye(2))
    return isp.requires_grad_(False).eval()


def test_the_forward_encoder_of_colour_sees_what_every_inverse_atom_makes(srgb: torch.Tensor) -> None:
    """An image that the first atom made comes back as it was under the first inverse, and not under the second."""
    isp, seen = two_lights(), list[torch.Tensor]()
    isp.forward_encoders.colour.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    x2 = srgb[:, :, ::4, ::4] ** 2.2
    x3 = torch.einsum("ij,bjhw->bihw", isp.colour.atoms()[0], x2)
    isp.choose_forward(x3 / isp.gain.channel_gains()[0].reshape(1, 3, 1, 1))
    (candidates,) = seen
    torch.testing.assert_close(candidates[:, 0], x2[..., : candidates.shape[-2], :], atol=1e-4, rtol=1e-3)
    assert (candidates[:, 1] - x2).abs().max() > 0.05


def test_the_forward_encoders_are_asked_after_the_shading_is_corrected() -> None:
    """Of a flat grey scene, dim in the corners, they see the same everywhere."""
    isp, seen = two_lights(), list[torch.Tensor]()
    isp.forward_encoders.gain.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    mask = cast(Any, isp.stages["shading"]).mask(frame_coordinates(32, 32))
    raw = 0.3 * mask.expand(1, 1, 32, 32)
    assert raw.max() / raw.min() > 1.5
    isp.forward(raw)
    (images,) = seen
    inside = images[..., 4:-4, 4:-4]
    assert (inside.amax((-2, -1)) / inside.amin((-2, -1))).max() < 1.01


def test_atoms_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    isp = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2))
    isp.info["held_out"] = [{"blind": float("nan")}]
    isp.save(tmp_path / "a.safetensors")
    assert DictionaryISP.from_pretrained(tmp_path / "a.safetensors").info["held_out"] == [{"blind": None}]
    with torch.no_grad():
        isp.gain.log_gains.fill_(1000.0)  # finite, but their exponentials are not
    isp.save(tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match=r"a\.safetensors: .*finite"):
        DictionaryISP.from_pretrained(tmp_path / "a.safetensors")
