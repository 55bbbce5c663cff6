"""A script that trains with it; mypy reads it, and nobody runs it."""

from typing import assert_type

import torch
from torch.utils.data import DataLoader, Dataset

import rawaug
from rawaug.data import demo_pictures

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
