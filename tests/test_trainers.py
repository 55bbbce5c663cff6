"""The files of docs/trainers.md run as KAIR, BasicSR and deepinv run a dataset of theirs."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

import rawaug

PAGE = Path(__file__).parents[1] / "docs" / "trainers.md"


@pytest.fixture
def trainer_file(tmp_path: Path, registries: None) -> Any:
    """Write the page's file of a name, as its reader does, and import it."""

    def load(name: str) -> ModuleType:
        for code in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL):
            if code.startswith(f'"""{name}"""'):
                break
        else:
            raise AssertionError(f"{name} is not on the page")

        path = tmp_path / Path(name).name
        path.write_text(code)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def train_step(noisy: Tensor, clean: Tensor) -> None:
    """One step of a network of four planes."""
    network = torch.nn.Conv2d(4, 4, 3, padding=1)
    loss = torch.nn.functional.l1_loss(network(noisy), clean)
    loss.backward()
    assert loss.isfinite()


def test_kair(trainer_file: Any) -> None:
    dataset_class = trainer_file("data/dataset_rawaug.py").DatasetRawaug

    train_set = dataset_class({"phase": "train", "dataroot_H": "demo:", "H_size": 32, "n_channels": 4})
    train_data = next(iter(DataLoader(train_set, batch_size=2, shuffle=True, drop_last=True)))
    assert train_data["L"].shape == (2, 4, 32, 32)
    assert not torch.equal(train_data["L"], train_data["H"])
    train_step(train_data["L"], train_data["H"])

    test_set = dataset_class({"phase": "test", "dataroot_H": "demo:", "H_size": 32, "n_channels": 4})
    loader = DataLoader(test_set, batch_size=1, shuffle=False)
    first, second = next(iter(loader)), next(iter(loader))
    assert torch.equal(first["L"], second["L"])
    assert Path(first["L_path"][0]).stem == Path(first["H_path"][0]).stem != ""


def test_basicsr(trainer_file: Any) -> None:
    module = trainer_file("basicsr/data/rawaug_dataset.py")
    assert module.__name__.endswith("_dataset")  # by which BasicSR looks for the files of datasets

    options: dict[str, Any] = {
        "name": "mine",
        "type": "RawaugDataset",
        "dataroot_gt": "demo:",
        "gt_size": 32,
        "scale": 1,
    }
    train_set = getattr(module, options["type"])({**options, "phase": "train"})
    enlarged = [index % len(train_set) for index in range(2 * len(train_set))]
    train_data = next(iter(DataLoader(train_set, batch_size=2, sampler=enlarged, drop_last=True)))
    assert train_data["lq"].shape == (2, 4, 32, 32)
    train_step(train_data["lq"], train_data["gt"])

    val_set = getattr(module, options["type"])({**options, "phase": "val"})
    loader = DataLoader(val_set, batch_size=1, shuffle=False)
    first, second = next(iter(loader)), next(iter(loader))
    assert torch.equal(first["lq"], second["lq"])
    assert Path(first["lq_path"][0]).stem != ""


def test_deepinv(trainer_file: Any) -> None:
    module = trainer_file("train.py")

    data = next(iter(module.train_dataloader))
    assert isinstance(data, (tuple, list))  # which deepinv.Trainer demands of measurements made beforehand
    x, y = data
    train_step(y, x)

    evaluation = module.loader("demo:", 64, 2, train=False)
    (clean, noisy), (_, again) = next(iter(evaluation)), next(iter(evaluation))
    assert torch.equal(noisy, again)

    pairs = rawaug.RawPairs("demo:", "universal", crop=64).freeze()
    assert torch.equal(clean[0], pairs[0].clean)
    assert torch.equal(noisy[0], pairs[0].noisy)
