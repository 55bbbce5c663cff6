"""PSNR without a reference: right by the truth, in the right order, and refused where the noise is not as stated."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

import rawaug
from rawaug import RawDenoiser, bayer
from rawaug.commands.judge import run
from rawaug.denoising.denoiser import Noisy
from rawaug.denoising.risk import bootstrap_error, combine_estimates, estimate_risk, probe_denoiser
from rawaug.evaluation.judge import judge_noisy
from rawaug.io import RawFrame, write_dng
from rawaug.metrics import psnr
from rawaug.noise import noise_model

LEVELS = (2e-3, 1e-5)


def scene(side: int = 320) -> Tensor:
    """Packed RAW ``(1, 4, side / 2, side / 2)``: smooth light, with texture in a quarter of it."""
    generator = torch.Generator().manual_seed(5)
    light = F.interpolate(torch.rand(1, 1, 6, 6, generator=generator), (side, side), mode="bicubic").clamp(0, 1)
    texture = torch.rand(1, 1, side, side, generator=generator) - 0.5
    texture[..., side // 2 :, :] = 0.0
    texture[..., side // 2 :] = 0.0
    return bayer.pack((0.05 + 0.4 * light + 0.1 * texture).clamp(0.02, 0.6), "RGGB")


def noisy_of(clean: Tensor, seed: int = 0, told: float = 1.0, **faults: float) -> Noisy:
    model = noise_model({"name": "SensorNoise", "settings": {"levels": list(LEVELS), **faults}})
    image = model.apply(clean, model.sample(1, torch.Generator().manual_seed(seed)))
    return Noisy.of(image, (told * LEVELS[0], told * LEVELS[1]), "RGGB")


def blurring(sides: int) -> RawDenoiser:
    """A mean over ``sides x sides`` cells, whose error the truth tells."""
    pad = sides // 2

    def blur(noisy: Tensor) -> Tensor:
        return F.avg_pool2d(F.pad(noisy, (pad,) * 4, mode="reflect"), sides, stride=1)

    return RawDenoiser.of(blur, name=f"mean {sides}")


@pytest.fixture
def denoisers() -> list[RawDenoiser]:
    return [blurring(3), blurring(5), RawDenoiser.of("Wavelet")]


def test_the_risk_of_a_linear_filter_is_that_of_algebra() -> None:
    """Without texture, a mean over nine leaves a ninth of the noise; the estimate's own deviation is a hundredth."""
    clean = torch.full((1, 4, 200, 200), 0.3)
    variance = LEVELS[0] * 0.3 + LEVELS[1]
    shares = []
    for seed in range(4):
        noisy = noisy_of(clean, seed)
        probe = probe_denoiser(blurring(3), noisy, seed)
        assert noisy.levels is not None
        shares.append(float(estimate_risk(probe, noisy.image, noisy.levels).mean()) / variance)
        assert float(probe.kept.mean()) == pytest.approx(1 / 9, abs=0.01)
    assert sum(shares) / 4 == pytest.approx(1 / 9, abs=0.012)
    with pytest.raises(ValueError, match="levels"):
        probe_denoiser(blurring(3), Noisy(clean))


def test_noise_drawn_on_the_result_tells_what_the_energy_of_the_noise_hides() -> None:
    """Non-local means leave so little of a smooth light that the unbiased estimate scatters by half of it."""
    clean = 0.3 + 0.1 * torch.linspace(0.0, 1.0, 64).expand(1, 4, 64, 64)
    everywhere = torch.ones_like(clean, dtype=torch.bool)
    denoiser = RawDenoiser.of("NonLocalMeans")
    unbiased, combined = [], []
    for seed in range(6):
        noisy = noisy_of(clean, seed)
        assert noisy.levels is not None
        probe = probe_denoiser(denoiser, noisy, seed, count=2)
        truth = float((probe.denoised - clean).square().mean())
        risk = float(estimate_risk(probe, noisy.image, noisy.levels).mean())
        deviation = math.sqrt(2.0 / clean.numel()) * float(probe.variance.mean())
        median, low, high = combine_estimates(risk, deviation, bootstrap_error(denoiser, probe, noisy, everywhere))
        assert low < median < high
        unbiased.append(risk / truth - 1.0)
        combined.append(median / truth - 1.0)
    spread, spread_unbiased = (max(errors) - min(errors) for errors in (combined, unbiased))
    assert max(map(abs, combined)) < 0.35 and spread < 0.5 * spread_unbiased


def test_the_unbiased_estimate_decides_where_it_is_precise() -> None:
    assert combine_estimates(2.0, 0.01, 1.0)[0] == pytest.approx(2.0, rel=0.01)
    assert combine_estimates(-1.0, 1.0, 1.0)[0] == pytest.approx(1.1, rel=0.1)
    assert combine_estimates(5.0, 1.0, 1.0)[2] > combine_estimates(1.0, 1.0, 1.0)[2] + 0.5, "a large one may be true"


def test_several_changes_scatter_less(denoisers: list[RawDenoiser]) -> None:
    noisy = noisy_of(scene(128))
    kept = [
        [float(probe_denoiser(denoisers[0], noisy, seed, count).kept.std()) for seed in range(2)] for count in (1, 4)
    ]
    assert max(kept[1]) < 0.6 * min(kept[0])
    assert judge_noisy(noisy, denoisers, probes=2).denoisers.keys() == judge_noisy(noisy, denoisers).denoisers.keys()


def test_the_estimate_is_the_truth_within_its_interval_and_finds_the_order(denoisers: list[RawDenoiser]) -> None:
    clean = scene()
    noisy = noisy_of(clean)
    judgement = judge_noisy(noisy, denoisers)
    assert judgement.refusals == ()
    assert judgement.psnr_noisy == pytest.approx(psnr(noisy.image, clean).item(), abs=0.1)

    truth = {one.name: psnr(one(noisy), clean).item() for one in denoisers}
    for name, judged in judgement.denoisers.items():
        assert judged.psnr == pytest.approx(truth[name], abs=0.25)
        assert judged.interval[0] < truth[name] < judged.interval[1]
    assert list(judgement.denoisers) == sorted(truth, key=lambda name: -truth[name])
    last = list(judgement.denoisers)[-1]
    assert judgement.denoisers[last].behind[0] == pytest.approx(max(truth.values()) - truth[last], abs=0.2)


def test_harm_is_found_where_it_is() -> None:
    """A wide mean gains on the smooth part and harms the textured quarter, and no other."""
    judged = judge_noisy(noisy_of(scene()), [blurring(7), RawDenoiser.of("Wavelet")]).denoisers["mean 7"]
    gain = judged.gain[0, 0]
    assert (gain[:4, :4] < 0).all() and (gain[6:, 6:] > 0.8).all()
    assert 0.15 < judged.harmed <= 0.25


def test_after_development_the_estimate_holds_to_first_order(denoisers: list[RawDenoiser]) -> None:
    clean = scene()
    noisy = noisy_of(clean)

    def develop(image: Tensor) -> Tensor:
        return bayer.demosaic(bayer.unpack(image, "RGGB"), "RGGB", "bilinear")[0].clamp_min(1e-4).sqrt()

    judgement = judge_noisy(noisy, denoisers, develop)
    for one in denoisers:
        truth = psnr(develop(one(noisy))[None], develop(clean)[None]).item()
        assert judgement.denoisers[one.name].psnr_srgb == pytest.approx(truth, abs=0.5)


@pytest.mark.parametrize("told", [0.5, 2.0])
def test_wrong_levels_are_refused(denoisers: list[RawDenoiser], told: float) -> None:
    refusals = judge_noisy(noisy_of(scene(), told=told), denoisers).refusals
    assert len(refusals) == 1 and "levels do not fit" in refusals[0]
    ratio = float(re.search(r"variance of ([0-9.]+)", refusals[0])[1])  # type: ignore[index]
    assert ratio * told == pytest.approx(1.0, abs=0.2)


def test_row_noise_is_refused_as_such(denoisers: list[RawDenoiser]) -> None:
    refusals = judge_noisy(noisy_of(scene(), row_var=6e-5), denoisers).refusals
    assert any("rows" in reason for reason in refusals) and not any("correlated" in reason for reason in refusals)


def test_a_demosaiced_frame_is_refused_as_correlated(denoisers: list[RawDenoiser]) -> None:
    noisy = noisy_of(scene())
    rgb = bayer.demosaic(bayer.unpack(noisy.image, "RGGB"), "RGGB", "bilinear")
    blurred = F.avg_pool2d(F.pad(rgb, (1, 1, 1, 1), mode="reflect"), 3, stride=1)
    again = Noisy.of(bayer.pack(bayer.mosaic(blurred, "RGGB"), "RGGB"), LEVELS, "RGGB")
    refusals = judge_noisy(again, denoisers).refusals
    assert len(refusals) == 1 and "correlated" in refusals[0]


def test_clipped_frames_are_refused(denoisers: list[RawDenoiser]) -> None:
    bright = Noisy.of(noisy_of(scene() * 3).image.clamp(max=1.0), LEVELS, "RGGB")
    assert any("clipped at white" in reason for reason in judge_noisy(bright, denoisers).refusals)

    dark = noisy_of(scene() * 0.01)
    clipped = Noisy.of(dark.image.clamp_min(0.0), LEVELS, "RGGB")
    assert any("at black" in reason for reason in judge_noisy(clipped, denoisers).refusals)


def test_a_file_is_judged_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noisy = noisy_of(scene())
    mosaic = bayer.unpack(noisy.image, "RGGB")[0].clamp(-0.05, 1.0)
    frame = RawFrame(mosaic, "RGGB", (800.0,) * 4, 16383.0, name="mine")
    write_dng(tmp_path / "mine.dng", frame)

    arguments = {"noise": LEVELS, "denoisers": ["Wavelet"], "picture": str(tmp_path / "map.png")}
    run([str(tmp_path / "mine.dng")], json=str(tmp_path / "mine.json"), **arguments)  # type: ignore[arg-type]
    text = capsys.readouterr().out
    assert "Wavelet" in text and "harmed" in text
    assert (tmp_path / "map.png").stat().st_size > 1000 and (tmp_path / "mine.json").stat().st_size > 100

    judgement = rawaug.judge(frame, ["Wavelet"], LEVELS, crop=256)
    assert math.isfinite(judgement.denoisers["Wavelet"].psnr)
    with pytest.raises(ValueError, match="mine: not judged"):
        run([str(tmp_path / "mine.dng")], noise=(1e-3, 5e-6), denoisers=["Wavelet"])
