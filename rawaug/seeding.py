"""Keyed randomness: a generator from (seed, key, ...), so that any draw can be repeated without the draws before it.

The keys are hashed with BLAKE2b; nearby keys give unrelated streams, and nothing depends on the global state, on the
number of workers or on the order in which samples are asked for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import torch


def derive_seed(*keys: int | str) -> int:
    """Derive a 63-bit seed from integers and strings, the same on every machine."""
    digest = hashlib.blake2b(repr(keys).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def keyed_generator(*keys: int | str, device: torch.device | str = "cpu") -> torch.Generator:
    """Make a ``torch.Generator`` on ``device`` that is seeded by :func:`derive_seed`."""
    return torch.Generator(device).manual_seed(derive_seed(*keys))


Generators = torch.Generator | Sequence[torch.Generator]
"""One generator for all samples of a batch, or one for each."""


def draw_rows(
    generators: Generators,
    draw: Callable[..., torch.Tensor],
    batch: int,
    *shape: int,
    dtype: torch.dtype = torch.float32,
) -> torch.Tensor:
    """Draw ``(batch, *shape)`` from one generator; or from one each, as every sample alone would be drawn.

    Args:
        generators: one generator, or ``batch`` of them.
        draw: ``torch.rand`` or ``torch.randn``, or ``torch.randint`` with its limit.
        batch, shape, dtype: of the result.

    Example:
        >>> alone = [torch.Generator().manual_seed(seed) for seed in (1, 2)]
        >>> draw_rows(alone, torch.rand, 2, 3).shape
        torch.Size([2, 3])
    """
    if not isinstance(generators, torch.Generator):
        if len(generators) > 1:
            return torch.cat([draw_rows(generator, draw, 1, *shape, dtype=dtype) for generator in generators])
        generators = generators[0]
    return draw((batch, *shape), generator=generators, device=generators.device, dtype=dtype)


def take_generators(generators: Generators, rows: Iterable[int]) -> Generators:
    """The generators of some rows of a batch."""
    if isinstance(generators, torch.Generator):
        return generators
    return [generators[row] for row in rows]


def world_size() -> int:
    """The number of processes of a distributed run; 1 without one."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return 1
    return torch.distributed.get_world_size()


def rank_key() -> tuple[int, ...]:
    """Give the rank as a key that separates the draws of processes; it is empty for rank 0 and a single process."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return ()
    rank = torch.distributed.get_rank()
    if rank == 0:
        return ()
    return (rank,)


@contextmanager
def initialise_from(seed: int) -> Iterator[None]:
    """Let layers that are made inside be float32 and draw their weights from ``seed``; the global state is restored."""
    default = torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(default)
