"""The paper's experiments as the command line runs them: their shortest form goes through and writes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rawaug.data.pairs import Pair
from rawaug.experiment.run import dry_run
from rawaug.isp.fit import FitConfig
from rawaug.paper import ablation, reconstruction
from rawaug.paper.ablation import Ablation
from rawaug.paper.reconstruction import Comparison


@pytest.fixture
def frames(frame_of: Callable[..., Pair], monkeypatch: pytest.MonkeyPatch) -> list[Pair]:
    """Three frames, which every dataset consists of, and whose pictures are all there are."""
    made = [frame_of(name) for name in "abc"]
    for module in (reconstruction, ablation):
        monkeypatch.setattr(module, "open_pairs", lambda spec, split: made)
    monkeypatch.setattr(reconstruction, "open_pictures", lambda spec, min_side: [frame.srgb for frame in made])
    return made


RUNS: dict[str, Comparison | Ablation] = {
    "reconstruction": Comparison(data="mine", methods=["dictionary", "upi"], seeds=3),
    "ablation": Ablation(data="mine", fit=FitConfig(atoms=3)),
}


@pytest.mark.parametrize(("kind", "settings"), RUNS.items(), ids=list(RUNS))
def test_a_dry_run_tries_everything_once_and_writes_nothing(
    kind: str,
    settings: Comparison | Ablation,
    frames: list[Pair],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dry_run(kind, replace(settings, out=str(tmp_path)))
    assert "no problems found" in capsys.readouterr().out and not list(tmp_path.iterdir())
