"""The plugin: pairs that replay, keyed Datasets, wrapped loaders."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, TensorDataset

from rawaug.augment import RawAugment, RawPair, RawPairs, wrap
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPConfig


@pytest.fixture(scope="module")
def isp() -> DictionaryISP:
    return DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3), torch.Generator().manual_seed(0))


@pytest.fixture
def augment(isp: DictionaryISP) -> RawAugment:
    return RawAugment(isp, noise="cycleisp_sidd")


@pytest.fixture
def srgb() -> Tensor:
    return torch.randint(256, (3, 3, 16, 20), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


class Pictures(Dataset[Tensor]):
    """Six pictures of different sizes, some sides odd."""

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index: int) -> Tensor:
        generator = torch.Generator().manual_seed(index)
        return torch.randint(256, (3, 21 + index, 30 - index), generator=generator, dtype=torch.uint8)


def assert_same(a: Any, b: Any) -> None:
    if isinstance(a, Tensor):
        assert torch.equal(a, b)
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    else:
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)


@pytest.mark.parametrize("sampling", ["convex", "perturb", "chosen"])
def test_parameters_replay_the_pair(isp: DictionaryISP, srgb: Tensor, sampling: Any) -> None:
    augment = RawAugment(isp, sampling=sampling)
    pair = augment(srgb)
    assert pair.noisy.shape == pair.clean.shape == pair.variance.shape == (3, 4, 8, 10)
    assert_same(augment.apply(srgb, pair.params), pair)


def test_noise_keeps_its_sign_at_black_and_is_cut_at_white(augment: RawAugment) -> None:
    black = augment(torch.zeros(4, 3, 64, 64)).noisy
    white = augment(torch.ones(4, 3, 64, 64)).noisy
    assert (black < 0).float().mean() > 0.4
    assert white.max() <= 1.0


def test_draws_differ_but_a_seed_repeats_them(isp: DictionaryISP, srgb: Tensor) -> None:
    a, b = RawAugment(isp, seed=1), RawAugment(isp, seed=1)
    first, second = a(srgb), a(srgb)
    assert not torch.equal(first.clean, second.clean)
    assert_same(b(srgb), first)


def test_a_picture_does_not_depend_on_its_batch(augment: RawAugment, srgb: Tensor) -> None:
    pair = augment(srgb)
    alone = pair.params._replace(
        isp=type(pair.params.isp)(*(v[1:2] for v in pair.params.isp)),
        noise={key: value[1:2] for key, value in pair.params.noise.items()},
        place=pair.params.place[1:2],
    )
    torch.testing.assert_close(augment.apply(srgb[1:2], alone).noisy, pair.noisy[1:2])


def test_unknown_sampling_is_refused(isp: DictionaryISP) -> None:
    with pytest.raises(ValueError, match="convex, perturb, chosen"):
        RawAugment(isp, sampling="random")  # type: ignore[arg-type]


def test_module_apply_still_visits_modules(augment: RawAugment) -> None:
    seen: list[nn.Module] = []
    nn.Sequential(augment).apply(seen.append)
    assert augment.isp in seen


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("batch", [1, 3])
def test_pairs_are_keyed_by_seed_epoch_and_index(augment: RawAugment, workers: int, batch: int) -> None:
    pairs = RawPairs(Pictures(), augment, crop=16, seed=7)
    expected = [pairs[i].noisy for i in range(6)]
    loader = DataLoader(pairs, batch_size=batch, num_workers=workers)
    got = torch.cat([item.noisy for item in loader])
    assert torch.equal(got, torch.stack(expected))


def test_another_epoch_or_seed_is_another_draw(augment: RawAugment) -> None:
    pairs = RawPairs(Pictures(), augment, crop=16, seed=7)
    first = pairs[0].clean
    pairs.set_epoch(1)
    assert not torch.equal(pairs[0].clean, first)
    pairs.set_epoch(0)
    assert torch.equal(pairs[0].clean, first)
    assert not torch.equal(RawPairs(Pictures(), augment, crop=16, seed=8)[0].clean, first)


def test_persistent_workers_see_the_epoch(augment: RawAugment) -> None:
    pairs = RawPairs(Pictures(), augment, crop=16)
    loader = DataLoader(pairs, num_workers=1, persistent_workers=True)
    first = next(iter(loader)).clean
    pairs.set_epoch(1)
    again = next(iter(loader)).clean
    assert not torch.equal(first, again)
    assert torch.equal(again[0], pairs[0].clean)


@pytest.mark.parametrize("form", ["numpy", "pil", "grey", "rgba", "chw"])
def test_what_datasets_yield_is_understood(augment: RawAugment, form: str) -> None:
    array = np.random.default_rng(0).integers(256, size=(18, 24, 3), dtype=np.uint8)
    forms: dict[str, Any] = {
        "numpy": array,
        "pil": Image.fromarray(array),
        "grey": array[..., 0],
        "rgba": np.concatenate([array, np.full((18, 24, 1), 255, np.uint8)], axis=2),
        "chw": torch.from_numpy(array).permute(2, 0, 1),
    }
    clean = RawPairs([forms[form]], augment, crop=16)[0].clean
    if form == "grey":
        array = np.repeat(array[..., :1], 3, axis=2)
    assert torch.equal(clean, RawPairs([array], augment, crop=16)[0].clean)


def test_labels_and_fields_pass_through(augment: RawAugment) -> None:
    picture = np.zeros((16, 16, 3), np.uint8)
    pair, label = RawPairs([(picture, 3)], augment, crop=16)[0]
    assert isinstance(pair, RawPair) and label == 3
    sample = RawPairs([{"image": picture, "id": "x"}], augment, crop=16, key="image")[0]
    assert isinstance(sample["image"], RawPair) and sample["id"] == "x"
    with pytest.raises(ValueError, match="image, id"):
        RawPairs([{"image": picture, "id": "x"}], augment, crop=16)[0]


def test_small_pictures_and_odd_crops_are_refused(augment: RawAugment) -> None:
    with pytest.raises(ValueError, match="picture 0 is 20 x 30"):
        RawPairs(Pictures(), augment, crop=64)[0]
    with pytest.raises(ValueError, match="even"):
        RawPairs(Pictures(), augment, crop=15)


def test_whole_pictures_lose_their_odd_line(augment: RawAugment) -> None:
    assert RawPairs(Pictures(), augment, crop=None)[0].noisy.shape == (4, 10, 15)


def test_wrapping_a_loader_is_one_line(augment: RawAugment, srgb: Tensor) -> None:
    loader = DataLoader(TensorDataset(srgb, torch.arange(3)), batch_size=2)
    wrapped = wrap(loader, augment)
    batches = list(wrapped)
    assert len(wrapped) == len(batches) == 2 and wrapped.batch_size == 2
    pair, labels = batches[0]
    assert pair.noisy.shape == (2, 4, 8, 10) and labels.tolist() == [0, 1]


def test_camera_noise_is_that_of_the_file(isp: DictionaryISP) -> None:
    with pytest.raises(ValueError, match="fitted without measuring noise"):
        RawAugment(isp, noise="camera")
    measured = DictionaryISP()
    measured.info["noise"] = {"shot_var": 2e-3, "read_var": 3e-5, "r2": 0.99}
    params = RawAugment(measured, noise="camera")(torch.rand(2, 3, 8, 8)).params
    torch.testing.assert_close(params.noise["shot_var"], torch.full((2,), 2e-3))
    torch.testing.assert_close(params.noise["read_var"], torch.full((2,), 3e-5))
