"""Patches: taken apart and put together, matched where they are alike, never outside the picture."""

from __future__ import annotations

import torch

from denoisers.patches import assemble, extract_patches, match_patches, patch_grid


def test_patches_put_together_are_the_picture() -> None:
    image = torch.rand(3, 11, 14, generator=torch.Generator().manual_seed(0))
    patches = extract_patches(image, 4)
    assert patches.shape == (3, 16, 8 * 11)
    again = assemble(patches, torch.ones(3, 1, patches.shape[2]), torch.zeros_like(image), 4)
    torch.testing.assert_close(again, image)


def test_pixels_that_no_patch_covers_stay() -> None:
    image = torch.rand(1, 8, 8, generator=torch.Generator().manual_seed(0))
    nothing = assemble(torch.zeros(1, 16, 25), torch.zeros(1, 1, 25), image, 4)
    assert torch.equal(nothing, image)


def test_the_grid_reaches_the_edges() -> None:
    grid = patch_grid(10, 13, side=4, step=3)
    assert sorted({int(index) // 10 for index in grid}) == [0, 3, 6]
    assert sorted({int(index) % 10 for index in grid}) == [0, 3, 6, 9]


def test_the_same_patch_is_found_again() -> None:
    guide = torch.rand(24, 24, generator=torch.Generator().manual_seed(0))
    guide[12:18, 13:19] = guide[10:16, 4:10]
    first, copy = 10 * 19 + 4, 12 * 19 + 13
    groups = match_patches(guide, torch.tensor([first, 0]), side=6, reach=10, count=5)
    assert groups[0, :2].tolist() == [first, copy]
    assert groups[1, 0] == 0 and groups.min() >= 0 and groups.max() < 19 * 19
