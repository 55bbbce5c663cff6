"""Which pairs a recipe uses."""

from __future__ import annotations

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import FrameLabel, LazyPairs, Pair, one_a_phone, selected, whole_scenes

PHONES = ("GP", "IP", "S6")
LABELS = [FrameLabel(f"{scene:03d}", phone, iso) for scene in (1, 2) for phone in PHONES for iso in (100, 400, 1600)]


class Shots(LazyPairs):
    """Eighteen tiny frames of two scenes by three phones; notes which were read."""

    def __init__(self) -> None:
        super().__init__([f"{k:04d}_{label.scene}_{label.phone}_010" for k, label in enumerate(LABELS)])
        self.labels = LABELS
        self.seen: list[int] = []

    def read(self, index: int) -> Pair:
        self.seen.append(index)
        return Pair(self.names[index], torch.zeros(3, 2, 2, dtype=torch.uint8), torch.zeros(1, 2, 2), CFA.RGGB)


def test_the_first_ones_are_of_one_phone_and_others_are_not() -> None:
    shots = Shots()
    first = selected(shots, 18, 3)
    assert first == [0, 1, 2] and {LABELS[k].phone for k in first} == {"GP"}
    one_each = selected(shots, 18, 3, "phones")
    assert not shots.seen, "none is read"
    assert sorted(LABELS[k].phone for k in one_each) == sorted(PHONES)
    assert {LABELS[k].iso for k in one_each} == {400}, "not base ISO"


def test_phones_take_turns_and_spread_in_iso() -> None:
    chosen = one_a_phone(LABELS, 8)
    counts = [sum(LABELS[k].phone == phone for k in chosen) for phone in PHONES]
    assert counts == [3, 3, 2] and len(set(chosen)) == 8
    assert [LABELS[k].phone for k in chosen[:3]] == list(PHONES)
    assert {LABELS[k].iso for k in chosen if LABELS[k].phone == "GP"} == {100, 400, 1600}
    with pytest.raises(ValueError, match=r"data\.count: 20 pairs are 7 of GP, which has 6"):
        one_a_phone(LABELS, 20)


def test_scenes_are_whole() -> None:
    assert whole_scenes(LABELS, 9) == list(range(9)) and whole_scenes(LABELS, 18) == list(range(18))
    with pytest.raises(ValueError, match=r"data\.count: 5 pairs are not whole scenes; use 9 or 18"):
        selected(Shots(), 18, 5, "scenes")


def test_names_are_of_frames_or_of_their_folders() -> None:
    assert selected(Shots(), 18, None, ["0004_001_IP_010", "0017_002_S6"]) == [4, 17]
    with pytest.raises(ValueError, match=r"data\.select: 0099 is none of the 18 frames, such as 0000_001_GP_010"):
        selected(Shots(), 18, None, ["0099"])


def test_what_is_held_out_is_not_chosen() -> None:
    assert selected(Shots(), 4, None) == [0, 1, 2, 3]
    assert max(selected(Shots(), 9, 3, "phones")) < 9 and selected(Shots(), 9, 9, "scenes") == list(range(9))
    with pytest.raises(ValueError, match="0017_002_S6 is none of the 9 frames"):
        selected(Shots(), 9, None, ["0017_002_S6"])


def test_what_has_no_labels_is_refused() -> None:
    pairs = list(Shots())
    assert selected(pairs, 18, 2) == [0, 1]
    with pytest.raises(ValueError, match="phones needs frames with labels"):
        selected(pairs, 18, 2, "phones")
    with pytest.raises(ValueError, match="'best' is unknown; use first, scenes, phones or a list of names"):
        selected(pairs, 18, 2, "best")
