"""One class for all that denoises RAW: found by name, told its levels, checked, in any pattern and at any strength."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional as F

import denoisers
from denoisers.pbrid import PBRID
from denoisers.published import BiasFreeDnCNN
from rawaug.bayer import CFA, pack, unpack
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.evaluation.evaluate import named_denoiser
from rawaug.experiment.full_colour import RgbRecipe
from rawaug.experiment.run import run
from rawaug.experiment.settings import ArmConfig, DataConfig
from rawaug.training.config import DenoiserConfig

LEVELS = (1.8e-3, 1.2e-5)


@pytest.fixture
def noisy() -> Noisy:
    """A grey ramp with the noise of a phone."""
    clean = torch.linspace(0.1, 0.9, 64).expand(1, 4, 64, 64)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return Noisy.of(clean + noise * (LEVELS[0] * clean + LEVELS[1]).sqrt(), LEVELS, CFA.RGGB)


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (lambda noisy, variance: noisy[..., 1:], r"mine: .*shape"),
        (lambda noisy, variance: noisy / 0, r"mine: .*finite"),
        (lambda noisy, variance: noisy @ noisy[..., 1:, :], "mine: RuntimeError: "),
    ],
)
def test_a_function_that_fails_is_named(run: Callable[..., Any], said: str, noisy: Noisy) -> None:
    with pytest.raises(ValueError, match=said) as error:
        RawDenoiser.of(run, name="mine")(noisy)
    assert "\n" not in str(error.value)


def test_a_function_is_imported_from_the_command_line_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "blind_one.py").write_text("def half(noisy):\n    return (noisy / 2).numpy()\n")
    monkeypatch.chdir(tmp_path)
    assert (named_denoiser("blind_one:half")(Noisy(torch.ones(1, 4, 8, 8))) == 0.5).all()
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')\n")
    given: dict[str, Any] = {"isp": "universal", "arms": {"joint": ArmConfig(1.0)}, "out": str(tmp_path)}
    network = DenoiserConfig("JointDRUNet", {"width": 4, "scales": 2})
    recipe = RgbRecipe(data=DataConfig(pairs=None), denoiser=network, baselines=["evil:f"], **given)
    with pytest.raises(FileNotFoundError, match="evil:f"):
        run(recipe)
    with pytest.raises(ValueError, match="evil:f"):
        RawDenoiser.of("evil:f")
    assert "evil" not in sys.modules


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("rawaug-smal", "nearest: rawaug-small"),
        ("", "no such denoiser"),
        ("nowhere:function", r"nowhere:function.*import"),
        ("json:nothing", r"json:nothing.*import"),
        ("gone.onnx", "gone.onnx"),
        ("gone.safetensors", "gone.safetensors"),
    ],
)
def test_what_is_no_denoiser_is_one_line(spec: str, said: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        named_denoiser(spec)


def test_networks_of_others_get_the_variance_if_they_take_two_arguments(noisy: Noisy) -> None:
    class Blind(torch.nn.Module):
        def forward(self, noisy: torch.Tensor) -> torch.Tensor:
            return noisy - 0.1

    class Told(torch.nn.Module):
        def forward(self, noisy: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
            return noisy + variance

    blind, told = RawDenoiser.of(Blind()), RawDenoiser.of(Told())
    assert (blind.reads_levels, told.reads_levels) == (False, True)
    assert noisy.variance is not None and torch.equal(told(noisy), noisy.image + noisy.variance)
    assert torch.equal(blind(noisy), noisy.image - 0.1)


def test_strength_blends_and_views_agree_with_a_denoiser_that_changes_nothing(noisy: Noisy) -> None:
    darker = RawDenoiser.of(lambda noisy: noisy - 0.05, name="darker", strength=0.4)
    torch.testing.assert_close(darker(noisy), noisy.image - 0.02)
    same = RawDenoiser.of(torch.nn.Identity(), views=8, cfa=CFA.GRBG)
    torch.testing.assert_close(same(noisy), noisy.image)
    with pytest.raises(ValueError, match="strength"):
        RawDenoiser.of("NonLocalMeans", strength=1.5)


def test_a_filter_in_tiles_and_a_filter_without_levels(noisy: Noisy) -> None:
    whole, tiled = (RawDenoiser.of("NonLocalMeans", tiles=tiles) for tiles in (None, (48, 16)))
    assert (whole(noisy) - tiled(noisy)).abs().max() < 1e-3
    unknown = noisy._replace(levels=None)
    assert not torch.equal(whole(unknown), whole(noisy)), "at the mean level, not stabilised"


def test_weights_of_others_are_known_by_their_tensors(tmp_path: Path, noisy: Noisy) -> None:
    save_file({f"conv{k:02}": torch.zeros(1, 1, 3, 3) for k in range(20)}, tmp_path / "bf.safetensors")
    save_file(denoisers.PMRID().state_dict(), tmp_path / "pmrid.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    assert RawDenoiser.of(tmp_path / "bf.safetensors").name == "BF-DnCNN"
    pmrid = RawDenoiser.of(tmp_path / "pmrid.safetensors")
    assert pmrid.name.startswith("PMRID") and pmrid(noisy).shape == noisy.image.shape
    save_file(PBRID().state_dict(), tmp_path / "pbrid.safetensors")
    pbrid = RawDenoiser.of(tmp_path / "pbrid.safetensors")
    assert pbrid.name.startswith("PBRID") and not pbrid.reads_levels and pbrid.cfa == CFA.RGGB
    assert pbrid(noisy).shape == noisy.image.shape
    (tmp_path / "finetuned").mkdir()
    denoisers.save(denoisers.build("DnCNN", width=4, depth=3), tmp_path / "finetuned" / "denoiser.safetensors", {})
    assert RawDenoiser.of(tmp_path / "finetuned" / "denoiser.safetensors").name == "finetuned"  # an arm of a run
    with pytest.raises(ValueError, match="denoiser"):
        RawDenoiser.of(tmp_path / "other.safetensors")


def test_bf_dncnn_takes_white_noise_out_of_the_stabilised_planes(noisy: Noisy) -> None:
    mean = torch.zeros(1, 1, 3, 3)
    mean[..., 1, 1] = 1.0
    away = mean - 1 / 9  # u - (u - mean of u)
    denoised = BiasFreeDnCNN({"conv00": torch.cat([away, -away]), "conv01": torch.cat([mean, -mean], dim=1)})(
        *noisy[:2]
    )
    clean = torch.linspace(0.1, 0.9, 64).expand(1, 4, 64, 64)
    inner = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    before, after = (((x - clean)[inner]).square().mean() for x in (noisy.image, denoised))
    assert after < before / 7  # of nine sites
    assert (denoised - clean)[inner].mean().abs() < 5e-4  # the exact unbiased inverse


@pytest.mark.parametrize("cfa", list(CFA))
def test_the_views_of_a_self_ensemble_keep_the_frame_s_own_pattern(cfa: CFA) -> None:
    """A mean over 3 x 3 sites of the mosaic commutes with flips and turns, unless its sites lie elsewhere."""

    def mean(noisy: Tensor, variance: Tensor) -> Tensor:
        return pack(F.avg_pool2d(unpack(noisy, cfa), 3, 1, 1, count_include_pad=False), cfa)

    noisy = torch.rand(1, 4, 16, 20, generator=torch.Generator().manual_seed(0))
    given = Noisy.of(noisy, (1e-3, 1e-5), cfa)
    plain, views = (RawDenoiser.of(mean, views=count)(given)[..., 3:-3, 3:-3] for count in (1, 8))
    torch.testing.assert_close(views, plain, rtol=0.0, atol=1e-6)
