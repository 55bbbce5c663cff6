"""Parameters: collated, saved, loaded, and the pair again bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.utils.data import default_collate

from rawaug.isp.config import ISPParams
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.params import AugmentParams, load_params, save_params


@pytest.fixture(scope="module")
def pairs(augment: RawAugment) -> RawPairs:
    generator = torch.Generator().manual_seed(0)
    pictures = [torch.randint(256, (3, 20 + 2 * i, 26), generator=generator, dtype=torch.uint8) for i in range(4)]
    return RawPairs(pictures, augment, crop=16, seed=3)


def test_saved_with_a_batch_they_replay_every_pair(pairs: RawPairs, tmp_path: Path) -> None:
    batch = default_collate([pairs[i] for i in range(4)])
    save_params(batch.params, tmp_path / "deep" / "batch.safetensors")
    loaded = load_params(tmp_path / "deep" / "batch.safetensors")
    assert loaded.tensors().keys() == batch.params.tensors().keys()
    elsewhere = RawPairs(pairs.dataset, pairs.augment, crop=16, seed=99)
    for i in range(4):
        params = loaded.map(lambda t, i=i: t[i])  # type: ignore[misc]
        again = elsewhere.replay(i, params)
        for name in ("noisy", "clean", "variance"):
            assert torch.equal(getattr(again, name), getattr(batch, name)[i])


def test_replay_refuses_another_picture(pairs: RawPairs) -> None:
    with pytest.raises(ValueError, match="picture of 22 x 26"):
        pairs.replay(3, pairs[1].params)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors"):
        load_params(tmp_path / "none.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"other.*no rawaug parameters"):
        load_params(tmp_path / "other.safetensors")
    save_file({"place": torch.zeros(5)}, tmp_path / "part.safetensors", {"kind": "augment_params"})
    with pytest.raises(ValueError, match=r"part\.safetensors: .* missing"):
        load_params(tmp_path / "part.safetensors")
    (tmp_path / "text.safetensors").write_text("not this")
    with pytest.raises(ValueError, match=r"text.*not a readable"):
        load_params(tmp_path / "text.safetensors")
    with pytest.raises(ValueError, match="place missing"):
        AugmentParams.from_tensors({f"isp.{name}": torch.zeros(1) for name in ISPParams._fields})
