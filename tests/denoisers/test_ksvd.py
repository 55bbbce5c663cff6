"""K-SVD: its dictionary, the update of atoms, sparse patches found again, texture gains."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from denoisers.ksvd import KSVD, overcomplete_cosines, update_atoms


def test_the_first_dictionary_is_of_unit_atoms_with_one_constant() -> None:
    dictionary = overcomplete_cosines()
    assert dictionary.shape == (64, 256)
    assert np.allclose(np.linalg.norm(dictionary, axis=0), 1.0)
    assert np.allclose(dictionary[:, 0], 1 / 8) and np.allclose(dictionary[:, 1:].sum(0), 0.0, atol=1e-9)


def test_updated_atoms_explain_more_and_one_true_atom_is_found() -> None:
    random = np.random.default_rng(0)
    atom = random.normal(size=64)
    atom /= np.linalg.norm(atom)
    patches = np.outer(atom, random.normal(size=50))
    start = atom + 0.5 * random.normal(size=64) / 8
    dictionary = (start / np.linalg.norm(start))[:, None]
    codes = dictionary.T @ patches

    before = np.square(patches - dictionary @ codes).sum()
    for _ in range(3):
        update_atoms(dictionary, codes, patches)
    assert np.square(patches - dictionary @ codes).sum() < 1e-6 * before
    assert abs(dictionary[:, 0] @ atom) == pytest.approx(1.0, abs=1e-6)


def test_a_patch_of_few_atoms_is_coded_by_these() -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    dictionary = overcomplete_cosines()
    patches = np.stack([80.0 * dictionary[:, 17] + 60.0 * dictionary[:, 120], np.zeros(64)], axis=1)
    method = KSVD(strength=0.01)
    codes = method._code(dictionary, patches)
    assert np.allclose(dictionary @ codes, patches, atol=0.2)
    assert not codes[:, 1].any() and np.count_nonzero(codes[:, 0]) <= 4


def test_stripes_gain() -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    i, j = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
    clean = (0.3 + 0.1 * torch.sin(1.3 * i + 0.7 * j)).expand(1, 4, 24, 24)
    noisy = clean + 0.03 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    cleaned = KSVD()(noisy, torch.full_like(noisy, 0.03**2))
    assert (cleaned - clean).square().mean() < 0.4 * (noisy - clean).square().mean()
