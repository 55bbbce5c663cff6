"""A descent that was stopped ends with the same bits as one that was not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, descent, fit_isp
from rawaug.isp.fit.descent import Descent
from rawaug.isp.model import DictionaryISP

TINY = FitConfig(steps=12, curve_steps=12, pixels=512, batch=128, prior_steps=20)
OFTEN: dict[str, Any] = {"report_steps": 5, "save_seconds": -1.0}


def stopped_at(step: int) -> Callable[[torch.Tensor], Callable[[torch.Generator], torch.Tensor]]:
    """A noisy bowl, whose ``step``-th evaluation is interrupted."""

    def bowl(x: torch.Tensor) -> Callable[[torch.Generator], torch.Tensor]:
        calls = 0

        def loss(generator: torch.Generator) -> torch.Tensor:
            nonlocal calls
            calls += 1
            if calls == step:
                raise KeyboardInterrupt
            return ((x - torch.randn(3, generator=generator)) ** 2).sum()

        return loss

    return bowl


def run(path: Path | None, key: str = "key", stop: int = 0, watch: bool = False, steps: int = 20) -> torch.Tensor:
    x = torch.zeros(3)
    loss = stopped_at(stop)(x)
    score = (lambda: -float((x.detach() - 0.1).abs().sum())) if watch else None
    Descent(path, key, 0, False, **OFTEN).run("bowl", loss, {"x": x}, steps, 0.1, watch=score)
    return x


@pytest.mark.parametrize("stop", [2, 7, 20])
@pytest.mark.parametrize("watch", [False, True])
def test_a_stopped_descent_goes_on_bit_for_bit(tmp_path: Path, stop: int, watch: bool) -> None:
    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        run(path, stop=stop, watch=watch)
    assert path.is_file()
    resumed = run(path, stop=20 - stop + 3, watch=watch)  # would be interrupted if it began anew
    assert torch.equal(resumed, run(None, watch=watch))
    assert torch.equal(run(path, stop=1, watch=watch), resumed)  # a stage that is done takes no step


def test_a_state_of_another_key_is_not_used(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "state", key="other", stop=7)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "state", stop=20)  # all of the first 19 steps again


def test_an_unreadable_state_is_named(tmp_path: Path) -> None:
    for damage in (b"", b"\x00" * 20, b"no state at all"):
        (tmp_path / "camera.state").write_bytes(damage)
        with pytest.raises(
            ValueError, match=r"camera\.state: not a readable safetensors file.*delete this state of an interrupted fit"
        ):
            Descent(tmp_path / "camera.state", "key", 0, False)


def test_watched_tensors_come_back_from_their_best_step() -> None:
    x = torch.zeros(3)
    worker = Descent(None, "key", 0, False, report_steps=5)
    worker.run("down", lambda g: x.sum(), {"x": x}, 20, 0.1, watch=lambda: -abs(float(x.detach().sum()) + 1.5))
    start, step, best = worker.watched["down"]
    assert (start, step) == (-1.5, 5) and best > -0.2  # 5 steps of 0.1 by Adam, three times
    assert -abs(float(x.sum()) + 1.5) == pytest.approx(best)


def test_a_stopped_fit_goes_on_bit_for_bit(tmp_path: Path, exact_pairs: list[Pair]) -> None:
    state, calls = tmp_path / "camera.state", 0

    def report(isp: DictionaryISP) -> str:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt
        return ""

    with pytest.raises(KeyboardInterrupt):
        fit_isp(exact_pairs, TINY, progress=False, state=state, report=report, **OFTEN)
    stopped = state.read_bytes()
    resumed = fit_isp(exact_pairs, TINY, progress=False, state=state, report=report, **OFTEN).state_dict()
    assert calls == 4  # after 5 and 10 steps, then after 10 and 12
    assert list(tmp_path.iterdir()) == []
    whole = fit_isp(exact_pairs, TINY, progress=False, **OFTEN).state_dict()
    assert all(torch.equal(resumed[key], whole[key]) for key in whole)

    # of other settings, or of frames about which the files say something else, it is not used
    liar = replace(exact_pairs[0], white_balance=(1.0, 1.0, 1.0))
    for pairs, config in ((exact_pairs, replace(TINY, learning_rate=1e-3)), ([liar, *exact_pairs[1:]], TINY)):
        state.write_bytes(stopped)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Descent, "_restored", _refusing(Descent._restored))
            fit_isp(pairs, config, progress=False, state=state, **OFTEN)


def _refusing(restored: Callable[..., tuple[int, Any]]) -> Callable[..., tuple[int, Any]]:
    def from_the_start(self: Descent, *args: object) -> tuple[int, Any]:
        step, state = restored(self, *args)
        assert step == 0
        return step, state

    return from_the_start


def test_what_it_shows_is_the_mean_loss_since_the_report_before(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []

    class Bar(list[int]):
        def set_postfix_str(self, text: str, refresh: bool) -> None:
            shown.append(float(text.split()[1]))

    monkeypatch.setattr(descent, "progress", lambda steps, **_: Bar(steps))
    x, values = torch.zeros(1), iter([1.0, 2.0, 3.0, 4.0, 5.0, 60.0, 10.0])
    Descent(None, "key", 0, False, report_steps=5).run("line", lambda _: next(values) + 0 * x.sum(), {"x": x}, 7, 0.1)
    assert shown == [3.0, 35.0]
