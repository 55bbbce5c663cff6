"""A process of a distributed run, without the others."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch


@pytest.fixture
def as_rank(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], None]:
    """``as_rank(1, 3)``: this process is the second of three."""

    def become(rank: int, processes: int) -> None:
        answers = {"is_initialized": True, "get_world_size": processes, "get_rank": rank}
        for question, answer in answers.items():
            monkeypatch.setattr(torch.distributed, question, lambda answer=answer: answer)

    return become
