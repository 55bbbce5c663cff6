"""Keyed seeds: fixed for all time, different for different keys."""

from __future__ import annotations

import torch

from rawaug.seeding import derived_seed, keyed_generator


def test_seeds_are_fixed_for_all_time() -> None:
    assert derived_seed(0, "noise", 17) == 7858587658179786899
    assert derived_seed() >= 0


def test_keys_do_not_run_together() -> None:
    assert len({derived_seed(1, 23), derived_seed(12, 3), derived_seed("1", 23), derived_seed(123)}) == 4


def test_generators_repeat_and_leave_the_global_state_alone() -> None:
    before = torch.get_rng_state()
    a, b = (torch.rand(4, generator=keyed_generator(5, "x")) for _ in range(2))
    assert torch.equal(a, b)
    assert torch.equal(before, torch.get_rng_state())
