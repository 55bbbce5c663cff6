"""Augmentations that tests share, and a process of a distributed run without the others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment


@pytest.fixture(scope="session")
def isp() -> DictionaryISP:
    return DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3))


@pytest.fixture(scope="session")
def augment(isp: DictionaryISP) -> RawAugment:
    return RawAugment(isp, noise="cycleisp_sidd")


@pytest.fixture(scope="session")
def universal() -> DictionaryISP:
    return DictionaryISP.from_pretrained("universal")


@pytest.fixture
def as_rank(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], None]:
    """``as_rank(1, 3)``: this process is the second of three."""

    def become(rank: int, processes: int) -> None:
        answers = {"is_initialized": True, "get_world_size": processes, "get_rank": rank}
        for question, answer in answers.items():
            monkeypatch.setattr(torch.distributed, question, lambda answer=answer: answer)

    return become


@pytest.fixture
def lightning_run() -> Callable[..., tuple[list[Tensor], Any]]:
    """Train a layer by Lightning on RAW pairs, from a checkpoint if one is given: what it saw, and its trainer."""
    lightning = pytest.importorskip("pytorch_lightning", reason="Lightning resumes: pip install rawaug[test]")

    class Layer(lightning.LightningModule):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.network, self.seen = torch.nn.Conv2d(4, 4, 1), list[Tensor]()

        def training_step(self, pair: Any, index: int) -> Tensor:
            self.seen.append(pair.noisy)
            return (self.network(pair.noisy) - pair.clean).abs().mean()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), lr=0.1)

    def run(data: Any, checkpoint: Path | None = None, **length: int) -> tuple[list[Tensor], Any]:
        quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
        trainer = lightning.Trainer(accelerator="cpu", enable_model_summary=False, **quiet, **length)
        layer = Layer()
        trainer.fit(layer, data, ckpt_path=checkpoint)
        return layer.seen, trainer

    return run
