"""Which of many pairs a recipe uses: the first ones, whole scenes, one phone after another, or by name.

A dataset that knows more of its frames than their names has ``labels``, one :class:`FrameLabel` a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, groupby
from typing import NamedTuple, Protocol, runtime_checkable

from rawaug.data.lazy import names_of
from rawaug.data.pair import Pair

SELECTIONS = ("first", "scenes", "phones")


class FrameLabel(NamedTuple):
    """The scene that a frame shows, the phone that took it, and its ISO."""

    scene: str
    phone: str
    iso: int


@runtime_checkable
class Labelled(Protocol):
    """A dataset whose frames have labels, known without reading any."""

    @property
    def labels(self) -> Sequence[FrameLabel]: ...


def selected(pairs: Sequence[Pair], kept: int, count: int | None, select: str | Sequence[str] = "first") -> list[int]:
    """Indices of ``count`` of the first ``kept`` pairs, of all of these if None; none is read.

    Args:
        pairs: the dataset.
        kept: number of pairs to choose from; the others are held out.
        count: how many.
        select: ``first``; ``scenes``, whole scenes until there are ``count`` pairs; ``phones``, as many of each phone,
            the middle ones by ISO; or names of frames, or of their folders (scene instances).

    Raises:
        ValueError: if a name is unknown, the dataset has no labels, or ``count`` is not that of whole scenes.

    Example:
        >>> labels = [FrameLabel("001", phone, iso) for phone in ("GP", "S6") for iso in (100, 400, 800)]
        >>> one_a_phone(labels, 2)
        [1, 4]
    """
    if not isinstance(select, str):
        return _named(names_of(pairs)[:kept], select)[:count]
    if select not in SELECTIONS:
        raise ValueError(f"data.select {select!r} is unknown; use {', '.join(SELECTIONS)} or a list of names")
    if select == "first":
        return list(range(kept)[:count])
    if not isinstance(pairs, Labelled):
        raise ValueError(f"data.select: {select} needs frames with labels, such as sidd:; use first or names")
    if count is None:
        return list(range(kept))
    choose = whole_scenes if select == "scenes" else one_a_phone
    return choose(pairs.labels[:kept], count)


def whole_scenes(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Indices of the first scenes, in order of their names, whose frames are ``count`` in all.

    Raises:
        ValueError: if no number of scenes has ``count`` frames; the numbers on either side are named.
    """
    order = sorted(range(len(labels)), key=lambda k: labels[k].scene)
    totals = list(accumulate(len(list(group)) for _, group in groupby(order, key=lambda k: labels[k].scene)))
    if count not in totals:
        near = sorted(totals, key=lambda total: abs(total - count))[:2]
        raise ValueError(
            f"data.count: {count} pairs are not whole scenes; use {' or '.join(map(str, sorted(near)))}, "
            "or select: first"
        )
    return order[:count]


def one_a_phone(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Indices of ``count`` frames, one phone after another; of each phone evenly spread in ISO.

    Raises:
        ValueError: if a phone has too few frames.
    """
    phones = sorted({label.phone for label in labels})
    chosen: list[list[int]] = []
    for place, phone in enumerate(phones):
        share = count // len(phones) + (place < count % len(phones))
        frames = sorted((k for k, label in enumerate(labels) if label.phone == phone), key=lambda k: labels[k].iso)
        if share > len(frames):
            raise ValueError(f"data.count: {count} pairs are {share} of {phone}, which has {len(frames)}")
        chosen.append([frames[(2 * i + 1) * len(frames) // (2 * share)] for i in range(share)])
    longest = max(len(frames) for frames in chosen)
    return [frames[i] for i in range(longest) for frames in chosen if i < len(frames)]


def _named(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    indices: list[int] = []
    for name in wanted:
        found = [k for k, known in enumerate(names) if known == name or known.rpartition("_")[0] == name]
        if not found:
            raise ValueError(f"data.select: {name} is none of the {len(names)} frames, such as {', '.join(names[:3])}")
        indices += [k for k in found if k not in indices]
    return indices
