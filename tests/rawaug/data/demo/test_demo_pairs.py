from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data import demo_pairs, demo_photographs, demo_pictures, open_pairs, open_pictures
from rawaug.data.demo import FRAME, PAIRS, PHOTOGRAPHS, PICTURES_ONLY, _leaves, _pair


def forget() -> None:
    """What was made, so that it is made anew."""
    _pair.cache_clear()
    _leaves.cache_clear()


@pytest.fixture
def made_anew() -> Iterator[None]:
    forget()
    yield
    forget()


def test_splits_share_no_photograph() -> None:
    names = [*PICTURES_ONLY, *(name for files in PHOTOGRAPHS.values() for name in files)]
    assert len(set(names)) == len(names)
    for split, files in PHOTOGRAPHS.items():
        photographs = demo_photographs(split)
        assert list(photographs) == [file.split(".")[0] for file in files]
        assert all(photograph.dtype == torch.uint8 and photograph.shape[0] == 3 for photograph in photographs.values())


@pytest.mark.usefixtures("made_anew")
@pytest.mark.parametrize("split", PHOTOGRAPHS)
def test_dead_leaves_of_a_split_are_textured_from_no_other(split: str, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[torch.Tensor] = []

    def record(height: int, width: int, sources: list[torch.Tensor], generator: torch.Generator) -> torch.Tensor:
        used.extend(sources)
        return torch.zeros(3, height, width, dtype=torch.uint8)

    monkeypatch.setattr("rawaug.data.demo.dead_leaves", record)
    demo_pairs(split)
    if split == "train":
        assert len(open_pictures("demo:")) == 32
    sources = {source.data_ptr() for source in used}
    for other in PHOTOGRAPHS:
        photographs = {photograph.data_ptr() for photograph in demo_photographs(other).values()}
        assert photographs <= sources if other == split else not photographs & sources


def test_pairs_of_every_split() -> None:
    for split, count in PAIRS.items():
        pairs = demo_pairs(split)
        assert len(pairs) == len({pair.name for pair in pairs}) == count
        for pair in pairs:
            assert pair.raw.shape == (1, *FRAME) and pair.cfa == CFA.GRBG and pair.registered
            assert pair.noisy is not None and pair.name.startswith(f"{split}_")
            assert (pair.raw >= 1).float().mean() < 0.01, "clipped"
    assert len({pair.shot_var for pair in demo_pairs("test")}) == 6


def test_a_pair_depends_on_its_key_alone() -> None:
    first = demo_pairs("train", 1)
    forget()
    longer = demo_pairs("train", 3)
    assert first[0] is not longer[0] and longer[0] is demo_pairs("train", 1)[0]
    assert torch.equal(first[0].srgb, longer[0].srgb)
    assert first[0].noisy is not None and longer[0].noisy is not None
    assert torch.equal(first[0].noisy, longer[0].noisy)
    assert not torch.equal(longer[0].raw, longer[1].raw)


def test_pictures_are_many_and_differ() -> None:
    photographs = 2 + len(PICTURES_ONLY)
    pictures = demo_pictures(photographs + 3)
    assert [tuple(picture.shape) for picture in pictures[photographs:]] == [(3, *FRAME)] * 3
    assert not torch.equal(pictures[-2], pictures[-1])
    forget()
    assert torch.equal(pictures[-2], demo_pictures(photographs + 2)[-1])
    assert len(demo_pictures(1)) == 1


def test_open_by_name() -> None:
    assert [pair.name for pair in open_pairs("demo:validation")] == [pair.name for pair in demo_pairs("validation")]
    assert len(open_pairs("demo:", split="train")) == PAIRS["train"]
    with pytest.raises(ValueError, match="demo: no split holdout; use one of train, validation, test"):
        open_pairs("demo:holdout")
    with pytest.raises(ValueError, match="count must be at least 1"):
        demo_pairs("train", 0)
