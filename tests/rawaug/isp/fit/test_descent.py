"""A stopped descent goes on bit for bit; every term of the losses, against its formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from rawaug.data.pairs import Pair
from rawaug.isp.config import ISPConfig
from rawaug.isp.fit import FitConfig, end_to_end, fit_isp, pipeline
from rawaug.isp.fit.descent import Descent, cycle_error, reading_error
from rawaug.isp.fit.samples import FitFrames, PixelSamples, sample_pixels
from rawaug.isp.model import DictionaryISP

TINY = FitConfig(steps=12, curve_steps=12, pixels=512, batch=128, prior_steps=20)


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every 5 steps a report."""
    monkeypatch.setattr(Descent, "report_steps", 5)


def run(path: Path | None, key: str = "key", stop: int = 0, watch: bool = False) -> torch.Tensor:
    """20 steps into a noisy bowl, whose ``stop``-th evaluation is interrupted."""
    x, calls = torch.zeros(3), count(1)

    def loss(generator: torch.Generator) -> torch.Tensor:
        if next(calls) == stop:
            raise KeyboardInterrupt
        return ((x - torch.randn(3, generator=generator)) ** 2).sum()

    score = (lambda: -float((x.detach() - 0.1).abs().sum())) if watch else None
    Descent(path, key, 0, False).run("bowl", loss, {"x": x}, 20, 0.1, watch=score)
    return x


@pytest.mark.parametrize("watch", [False, True])
def test_a_stage_that_is_done_takes_no_step_and_another_begins_anew(tmp_path: Path, watch: bool) -> None:
    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        run(path, stop=7, watch=watch)
    whole = run(path, watch=watch)
    assert torch.equal(whole, run(None, watch=watch))
    assert torch.equal(run(path, stop=1, watch=watch), whole)
    with pytest.raises(KeyboardInterrupt):
        run(path, key="other", stop=1)


def test_watched_tensors_come_back_from_their_best_step() -> None:
    x = torch.zeros(3)
    worker = Descent(None, "key", 0, False)
    worker.run("down", lambda g: x.sum(), {"x": x}, 20, 0.1, watch=lambda: -abs(float(x.detach().sum()) + 1.5))
    step, best = worker.best("down")
    scores = [score for _, score in worker.scores["down"]]
    assert (scores[0], step) == (-1.5, 5) and best > -0.2  # 5 steps of 0.1 by Adam, three times
    assert max(scores) == best
    assert -abs(float(x.sum()) + 1.5) == pytest.approx(best)


def test_a_stopped_fit_goes_on_bit_for_bit(
    tmp_path: Path, exact_pairs: list[Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    state, calls = tmp_path / "camera.state", 0

    def report(isp: DictionaryISP) -> str:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt
        return ""

    with pytest.raises(KeyboardInterrupt):
        fit_isp(exact_pairs, TINY, progress=False, state=state, report=report)
    stopped = state.read_bytes()
    resumed = fit_isp(exact_pairs, TINY, progress=False, state=state, report=report).state_dict()
    assert calls == 5  # after 5 and 10 steps, then after 5, 10 and 12
    assert list(tmp_path.iterdir()) == []
    whole = fit_isp(exact_pairs, TINY, progress=False).state_dict()
    assert all(torch.equal(resumed[key], whole[key]) for key in whole)

    # of other settings, or of frames about which the files say something else, it is not used
    liar, known = (
        replace(exact_pairs[0], clean=replace(exact_pairs[0].clean, white_balance=(1.0, 1.0, 1.0))),
        list[bool](),
    )

    class Noted(Descent):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            known.append(bool(self._ends))

    monkeypatch.setattr(pipeline, "Descent", Noted)
    other = replace(TINY, learning_rate=1e-3)
    for pairs, config in ((exact_pairs, other), ([liar, *exact_pairs[1:]], TINY), (exact_pairs, TINY)):
        state.write_bytes(stopped)
        fit_isp(pairs, config, progress=False, state=state)
    assert known == [False, False, True]


CLEAN, NOISY = FitConfig(), FitConfig(noisy=True)


@pytest.fixture(scope="module")
def frame(exact_pair: Callable[..., Pair]) -> FitFrames:
    return sample_pixels([exact_pair("shot", (1.6, 1.0, 1.7), 0, size=(32, 40))], 64, 0)


@pytest.fixture
def isp() -> DictionaryISP:
    """Two atoms of each kind, between which the two directions choose differently."""
    model = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2, encoders=False, attention=False))
    with torch.no_grad():
        model.colour.matrices.add_(0.1 * torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0)))
        model.reverse_encoders.colour.set_prior(torch.tensor([0.7, 0.3]))
        model.forward_encoders.colour.set_prior(torch.tensor([0.4, 0.6]))
        model.reverse_encoders.gain.set_prior(torch.tensor([0.9, 0.1]))
        model.forward_encoders.gain.set_prior(torch.tensor([0.5, 0.5]))
    return model


APART = 2 * 0.3**2 + 2 * 0.4**2
"""|w_r - w_f|^2 of these priors."""


def both_passes(isp: DictionaryISP, part: PixelSamples) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """Intermediate images of the two passes under the reverse weights, and the sRGB of the forward one."""
    params = isp.choose(part.srgb)
    back: dict[str, Tensor] = {}
    back["raw"] = isp.stages.reverse(part.cell_srgb, params, part.coordinates, back)
    ahead: dict[str, Tensor] = {}
    srgb = isp.stages.forward(part.cell_raw, params, part.coordinates, ahead)
    return back, ahead, srgb


def test_the_cycle_is_l2_on_srgb_and_a_tenth_on_every_image_between(isp: DictionaryISP, frame: FitFrames) -> None:
    part, _ = frame
    back, ahead, srgb = both_passes(isp, part)
    assert set(ahead) == {"x1", "x2", "x3", "x4"} <= set(back)
    weight = part.cell_weight / (3.0 * part.cell_weight.sum())
    expected = ((srgb - part.cell_srgb) ** 2 * weight).sum()
    for name in ahead:
        expected = expected + 0.1 * ((ahead[name] - back[name]) ** 2 * weight).sum()
    error = cycle_error(isp, part, isp.choose(part.srgb), back, CLEAN)
    assert error.item() == pytest.approx(expected.item(), rel=1e-5)
    for name in ahead:
        shifted = {**back, name: ahead[name] + 0.5}
        without = {**back, name: ahead[name]}
        rise = cycle_error(isp, part, isp.choose(part.srgb), shifted, CLEAN) - cycle_error(
            isp, part, isp.choose(part.srgb), without, CLEAN
        )
        assert rise.item() == pytest.approx(0.1 * 0.5**2, rel=1e-4), name


@pytest.mark.parametrize("stage", ["encoders", "joint"])
def test_a_fit_shows_the_forward_encoders_what_the_forward_pass_does(
    stage: str, exact_pair: Callable[..., Pair]
) -> None:
    """Of a flat frame under strong shading: the same light everywhere."""
    isp = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2, attention=False))
    with torch.no_grad():
        cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), 3.0 * torch.eye(2))
    flat = isp.reverse(torch.full((1, 3, 32, 40), 0.5)).raw[0]
    pair = exact_pair("shot", (1.6, 1.0, 1.7), 0, size=(32, 40))
    part, shots = sample_pixels([replace(pair, clean=replace(pair.clean, mosaic=flat))], 64, 0)
    seen: list[Tensor] = []
    isp.forward_encoders.colour.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    if stage == "encoders":
        end_to_end._encoder_loss(isp, part, shots[0], CLEAN, torch.Generator().manual_seed(0))
    else:
        end_to_end._joint_loss(isp, part, shots[0].srgb, isp.stages.remove_shading(shots[0].raw, None), CLEAN)
    shaded = shots[0].raw.std((2, 3)) / shots[0].raw.mean((2, 3))
    corrected = seen[0].std((3, 4)) / seen[0].mean((3, 4)).abs()
    assert corrected.max() < 0.2 * shaded.max()  # borders of the demosaicing remain


def test_readings_weigh_as_shot_noise_has_it(frame: FitFrames) -> None:
    part, _ = frame
    known = part.known.bool()
    predicted = torch.where(known, part.target + 0.01, part.target)
    expected = (0.01**2 / (4.0 * (predicted[known] + 0.01))).mean()
    assert reading_error(predicted, part).item() == pytest.approx(expected.item(), rel=1e-5)
