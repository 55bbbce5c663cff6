"""Which frames a sequence of pairs holds, without reading them: what is trained on must not be scored.

A frame is identified by the resolved paths of its files where it has some, else by its name.
"""

from __future__ import annotations

from collections.abc import Sequence

from rawaug.data.lazy import LazyPairs, SomePairs
from rawaug.data.pair import Pair
from rawaug.files import digest


def shared_frame(first: Sequence[Pair], second: Sequence[Pair]) -> str | None:
    """A frame that both hold, by its path or name; None if they share none.

    Example:
        >>> from rawaug.data import demo_pairs
        >>> shared_frame(demo_pairs("train"), demo_pairs("train", count=1))
        'train_00_astronaut'
    """
    return min(_identities(first) & _identities(second), default=None)


def stamps(pairs: Sequence[Pair]) -> list[str]:
    """What a stage depends on, by frame, without reading files again.

    Path, size and modification time of files; names of a dataset's frames; samples of the content of frames in memory.
    """
    if isinstance(pairs, SomePairs) and not isinstance(pairs.pairs, LazyPairs):
        return [_sampled(pair) for pair in pairs]
    if isinstance(pairs, LazyPairs):
        return [pairs.stamp(index) for index in range(len(pairs))]
    return [_sampled(pair) for pair in pairs]


def _identities(pairs: Sequence[Pair]) -> set[str]:
    if not isinstance(pairs, LazyPairs):
        return {pair.name for pair in pairs}
    found = set()
    for index, name in enumerate(pairs.names):
        files = pairs.files_of(index)
        found |= {str(file.resolve()) for file in files} if files else {name}
    return found


def _sampled(pair: Pair) -> str:
    known = repr((pair.name, pair.camera, pair.cfa, pair.white_balance, pair.raw.shape)).encode()
    images = [image for image in (pair.srgb, pair.raw, pair.noisy) if image is not None]
    return digest(known, *(image.flatten()[::4099].numpy().tobytes() for image in images))[:16]
