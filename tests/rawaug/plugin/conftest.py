"""Augmentations that tests share, and a process of a distributed run without the others."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

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
