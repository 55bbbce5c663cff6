"""Each process of a distributed run its share of a DataLoader.

PyTorch divides nothing by itself, and Lightning and Fabric divide only what is a DataLoader, which a wrapped one is
not. So the share is taken here, where the loader was left to choose its order: one that is sequential or shuffled over
the whole dataset gets a ``DistributedSampler`` in its place, as Lightning does.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch.utils.data import BatchSampler, DataLoader, DistributedSampler, RandomSampler, SequentialSampler


def world_size() -> int:
    """Processes of the distributed run; 1 without one."""
    distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if distributed else 1


def own_share(loader: Any, seed: int) -> Any:
    """The loader over the pictures of this process; itself, if it is divided already or cannot be.

    A loader with a sampler or batch sampler that was passed to it, one of an iterable dataset, and what is no
    DataLoader at all stay as they are.

    Args:
        loader: any loader.
        seed: of the shuffled order, the same in every process.
    """
    if world_size() == 1 or not isinstance(loader, DataLoader) or not _chose_its_order(loader):
        return loader
    shuffle = isinstance(loader.sampler, RandomSampler)
    dataset: Any = loader.dataset
    sampler: DistributedSampler[Any] = DistributedSampler(
        dataset, shuffle=shuffle, seed=seed, drop_last=loader.drop_last
    )
    share = copy.copy(loader)
    batches = BatchSampler(sampler, loader.batch_size, loader.drop_last) if loader.batch_size is not None else None
    # A DataLoader refuses another sampler once it is made; a copy that has no iterator yet may have one.
    share.__dict__.update(sampler=sampler, batch_sampler=batches, _iterator=None)
    return share


def _chose_its_order(loader: DataLoader[Any]) -> bool:
    """Whether the sampler is the one that the loader made from ``shuffle``."""
    sampler, batches = loader.sampler, loader.batch_sampler
    if batches is not None and not (type(batches) is BatchSampler and batches.sampler is sampler):
        return False
    if type(sampler) is RandomSampler:
        return not sampler.replacement and sampler.num_samples == len(sampler.data_source)
    return type(sampler) is SequentialSampler
