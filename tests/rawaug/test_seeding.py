"""Keyed seeds: fixed for all time, different for different keys."""

from __future__ import annotations

import torch

from rawaug.seeding import derive_seed, keyed_generator


def test_seeds_are_fixed_for_all_time() -> None:
    assert derive_seed(0, "noise", 17) == 7858587658179786899
    assert derive_seed() >= 0


def test_keys_do_not_run_together() -> None:
    assert len({derive_seed(1, 23), derive_seed(12, 3), derive_seed("1", 23), derive_seed(123)}) == 4


def test_generators_repeat_and_leave_the_global_state_alone() -> None:
    before = torch.get_rng_state()
    a, b = (torch.rand(4, generator=keyed_generator(5, "x")) for _ in range(2))
    assert torch.equal(a, b)
    assert torch.equal(before, torch.get_rng_state())
