"""Threads over rows: every row once, in forked processes too; and machine code without a place to keep it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader, Dataset

from rawaug import bayer
from rawaug.isp.model import DictionaryISP
from rawaug.kernels import runtime
from rawaug.plugin.augment import RawAugment

PICTURE = torch.randint(256, (1, 3, 512, 512), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 300), st.sampled_from([1, 1000, 10**6]), st.integers(1, 3))
def test_every_row_is_done_once(rows: int, width: int, threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    done: list[int] = []
    runtime.run_over_rows(rows, width, lambda start, stop: done.extend(range(start, stop)))
    torch.set_num_threads(before)
    assert sorted(done) == list(range(rows))


def test_an_error_in_a_thread_is_raised(two_threads: None) -> None:
    def fail(start: int, stop: int) -> None:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        runtime.run_over_rows(8, 10**6, fail)


@pytest.mark.skipif(not runtime.has_numba(), reason="without Numba there are no loops")
@pytest.mark.parametrize("method", bayer.DIRECTIONAL)
@pytest.mark.parametrize("cfa", list(bayer.CFA))
def test_choices_of_direction_are_those_of_pytorch(cfa: bayer.CFA, method: str, two_threads: None) -> None:
    """But near the border, where the loops reflect the mosaic once and PyTorch every step."""
    from rawaug.kernels.cpu import demosaic_directional

    raw = torch.rand(2, 1, 200, 700, generator=torch.Generator().manual_seed(0))
    ours, expected = demosaic_directional(raw, cfa, method), bayer.demosaic(raw, cfa, method)
    torch.testing.assert_close(ours[..., 6:-6, 6:-6], expected[..., 6:-6, 6:-6], atol=1e-5, rtol=0)
    assert torch.equal(bayer.mosaic(ours, cfa), raw)
    assert demosaic_directional(raw[..., :4, :4], cfa, method).isfinite().all()


@pytest.mark.skipif(not runtime.has_numba(), reason="without Numba there are no loops")
def test_a_demosaicing_that_chooses_directions_needs_no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    from rawaug.kernels.cpu import demosaic_directional

    raw = torch.rand(1, 1, 16, 16, generator=torch.Generator().manual_seed(0))
    monkeypatch.setitem(bayer.DIRECTIONAL, "flat", lambda raw, cfa: raw.expand(-1, 3, -1, -1))
    monkeypatch.setattr("rawaug.bayer.demosaicing.METHODS", (*bayer.METHODS, "flat"))
    assert torch.equal(demosaic_directional(raw, bayer.CFA.RGGB, "flat"), raw.expand(-1, 3, -1, -1))


class Augmented(Dataset[torch.Tensor]):
    """The same pair over and over."""

    def __init__(self, augment: RawAugment) -> None:
        self.augment = augment
        self.params = augment.sample(PICTURE, torch.Generator().manual_seed(0))

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        own = torch.get_num_threads()
        torch.set_num_threads(2)  # a worker has one by default, and would not need threads
        noisy: torch.Tensor = self.augment.apply(PICTURE, self.params).noisy
        torch.set_num_threads(own)  # PyTorch's own threads do not survive a fork
        return noisy[0]


def test_forked_workers_go_on_where_the_parent_used_threads(two_threads: None) -> None:
    pairs = Augmented(RawAugment(DictionaryISP()))
    own = pairs[0]
    loader = DataLoader(pairs, batch_size=2, num_workers=2, multiprocessing_context="fork", timeout=300)
    for batch in loader:
        assert all(torch.equal(noisy, own) for noisy in batch)


def test_code_that_cannot_be_kept_is_compiled_all_the_same() -> None:
    made: dict[str, Callable[[int], int]] = {}
    exec("def double(x):\n    return 2 * x", made)  # no file, so no place beside it
    assert runtime.compile_loop(made["double"])(21) == 42
