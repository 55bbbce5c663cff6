"""The selection of pairs for a recipe: the first ones, whole scenes, one of each phone in turn, or names."""

from __future__ import annotations

from collections.abc import Sequence

from rawaug.data.frames import FrameLabel, as_frames
from rawaug.data.pairs import Pair
from rawaug.errors import count_of


def select_pairs(
    pairs: Sequence[Pair], available: int, count: int | None, select: str | Sequence[str] = "first"
) -> list[int]:
    """Select ``count`` of the first ``available`` pairs, or all for None; return their indices without reading a pair.

    ``select`` is a method (``first``, ``scenes`` or ``phones``) or a list of names.
    """
    if not isinstance(select, str):
        return _indices_of_names(as_frames(pairs).names[:available], select)[:count]
    if select == "first":
        return list(range(available)[:count])

    methods = {"scenes": whole_scenes, "phones": one_a_phone}
    if select not in methods:
        raise ValueError(f"data.select {select!r} is unknown; use first, {', '.join(methods)} or a list of names")
    labels = as_frames(pairs).labels
    if not labels:
        raise ValueError(f"data.select: {select} needs frames with labels, such as sidd:; use first or names")

    if count is None:
        return list(range(available))
    return methods[select](labels[:available], count)


def whole_scenes(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Get the indices of the frames of the first scenes in order of their names, ``count`` frames in all."""

    def frame_scene(index: int) -> str:
        return labels[index].scene

    order = sorted(range(len(labels)), key=frame_scene)
    totals = []
    for position, index in enumerate(order, start=1):
        is_last_of_scene = position == len(order) or frame_scene(order[position]) != frame_scene(index)
        if is_last_of_scene:
            totals.append(position)

    if count not in totals:
        nearest = sorted(totals, key=lambda total: abs(total - count))[:2]
        advice = " or ".join(map(str, sorted(nearest)))
        raise ValueError(f"data.count: {count} is no number of whole scenes; use {advice}, or select: first")
    return order[:count]


def one_a_phone(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Get indices of ``count`` frames, by phones in turn; the frames of each phone are evenly spread in ISO."""

    def frame_iso(index: int) -> int:
        return labels[index].iso

    frames_of: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        frames_of.setdefault(label.phone, []).append(index)

    selection: list[list[int]] = []
    phones = sorted(frames_of)
    for position, phone in enumerate(phones):
        share = count // len(phones)
        if position < count % len(phones):
            share += 1
        frames = sorted(frames_of[phone], key=frame_iso)
        if share > len(frames):
            pairs = count_of(len(frames), "pair")
            raise ValueError(f"data.count: {count} takes {share} of {phone}, which has {pairs}")
        selection.append([frames[(2 * turn + 1) * len(frames) // (2 * share)] for turn in range(share)])

    order: list[int] = []
    for turn in range(max(map(len, selection))):
        for frames in selection:
            if turn < len(frames):
                order.append(frames[turn])
    return order


def _indices_of_names(names: Sequence[str], selection: Sequence[str]) -> list[int]:
    """Get the indices of the frames in ``selection``, which has names of frames or of scene instances."""
    indices: list[int] = []
    for name in selection:
        matches = []
        for index, frame in enumerate(names):
            instance = frame.rpartition("_")[0]
            if name in (frame, instance):
                matches.append(index)

        if not matches:
            examples = ", ".join(names[:3])
            raise ValueError(f"data.select: {name} is not among {count_of(len(names), 'frame')}, such as {examples}")
        for index in matches:
            if index not in indices:
                indices.append(index)
    return indices
