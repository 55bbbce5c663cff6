"""A package that extends rawaug and a script that trains with it are typed: `mypy --strict` has nothing to say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

PACKAGE = '''
"""A network, a noise model, a reader and a command, as another package brings them by entry points."""

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import torch
from denoisers.network import Denoiser, Shared, conv
from rawaug.bayer import CFA
from rawaug.data import Pair, open_pairs
from rawaug.io import RawFrame
from rawaug.noise import Compose, RowNoise, ShotReadNoise, noise_levels
from torch import Tensor


class Shallow(Denoiser):
    def __init__(self, width: int = 16, **shared: Unpack[Shared]) -> None:
        super().__init__({"width": width}, **shared)
        self.first, self.last = conv(self.inputs, width), conv(width, self.channels)
        self.initialise(self.seed, self.last)

    def residual(self, features: Tensor) -> Tensor:
        hidden: Tensor = self.first(features)
        correction: Tensor = self.last(hidden.relu())
        return correction


class Banded(Compose):
    def __init__(self, levels: str = "cycleisp_sidd", row_var: float = 1e-6) -> None:
        super().__init__([ShotReadNoise(noise_levels(levels)), RowNoise(row_var)])


def read_frames(path: str, split: str) -> Sequence[Pair]:
    raw = torch.load(Path(path), weights_only=True)
    return [Pair("frame", RawFrame(raw, CFA.RGGB), torch.zeros(3, *raw.shape[-2:], dtype=torch.uint8))]


def count(data: str) -> None:
    """Count the frames of a dataset."""
    print(len(open_pairs(data)))
'''

SCRIPT = """
import rawaug
import torch
from rawaug.data import demo_pictures
from torch.utils.data import DataLoader, Dataset
from typing import assert_type

matrix = torch.eye(3)
camera = rawaug.Camera("M1", matrix=matrix, matrix_is="srgb_to_camera", white_balance=(2, 1, 2))
augment = rawaug.RawAugment.from_pretrained("universal", camera=camera, noise=(1e-3, 1e-5))
pictures: Dataset[torch.Tensor] = demo_pictures(4)

pairs = rawaug.RawPairs(pictures, augment, crop=64)
assert_type(pairs[0], rawaug.RawPair)
assert_type(rawaug.RawPairs("photographs", "universal", crop=64)[0], rawaug.RawPair)
assert_type(rawaug.RawPairs(pictures, augment, crop=64, keys=("lq", "gt"))[0].keys().__len__(), int)
assert_type(augment(torch.rand(1, 3, 8, 8)), rawaug.RawPair)
assert_type(pairs[0].noisy, torch.Tensor)
for pair in rawaug.wrap(DataLoader(pictures), augment):
    assert_type(pair, rawaug.RawPair)
for batch in rawaug.resumable(DataLoader(pairs)):
    print(batch.noisy)
clean = rawaug.RawPairs([torch.rand(4, 32, 32)], rawaug.RawNoise("cycleisp_sidd"), crop=32)
assert_type(clean[0].variance, torch.Tensor)
"""


@pytest.mark.long
def test_a_package_and_a_script_are_strictly_typed(tmp_path: Path) -> None:
    (tmp_path / "abroad.py").write_text(PACKAGE)
    (tmp_path / "train.py").write_text(SCRIPT)
    options = ["--strict", "--ignore-missing-imports", "--follow-imports=silent"]
    command = [sys.executable, "-m", "mypy", *options, "abroad.py", "train.py"]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}  # mypy does not follow an editable installation
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    ours = [line for line in done.stdout.splitlines() if line.startswith(("abroad.py", "train.py"))]
    assert not [line for line in ours if ": error:" in line], done.stdout
    assert "error" not in done.stderr
