r"""K-SVD: sparse patches over a dictionary that is learned from the noisy picture (Elad and Aharon, TIP 2006).

Patches y of 8 x 8 are coded by orthogonal matching pursuit with as few atoms as leave :math:`|y - D x|^2 \le (1.15
\sigma)^2 \cdot 64`. The dictionary D has 256 atoms, which begin as overcomplete cosines and are learned from a part of
the patches. Each atom in turn becomes the direction that best explains what the other atoms leave of the patches that
use it (Aharon et al., TSP 2006; with one power iteration of the rank-one problem, as in Rubinstein et al. 2008).
Estimates are averaged where patches overlap. The published share of the noisy picture in this mean, 30 / 255 over
sigma, is left out, because RAW has no fixed range.

The pursuit is scikit-learn's. The colours are filtered as luminance and differences, each with a dictionary of its own.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import torch

from denoisers.classical import FILTERS, Classical, Planes, from_opponent, to_opponent
from denoisers.patches import assemble, extract_patches, patch_grid

SIDE, STEP = 8, 2
"""A patch has this side, and the patches that are coded are this far apart, in packed pixels."""
ATOMS_A_SIDE = 16
"""The dictionary has this many atoms along each side, 256 in all."""
GAIN = 1.15
"""A patch is explained up to this published multiple of the noise's deviation."""
ROUNDS = 5
"""The dictionary is improved this many times."""
TRAINING_PATCHES = 4000
"""The dictionary is learned from about this many patches."""

Array = np.ndarray[Any, np.dtype[np.float64]]


def overcomplete_cosines() -> Array:
    """Compute the initial dictionary ``(64, 256)`` of products of sampled cosines; its columns have length 1."""
    position = np.arange(SIDE)
    waves: Array = np.cos(np.outer(position, np.arange(ATOMS_A_SIDE)) * math.pi / ATOMS_A_SIDE)
    waves[:, 1:] -= waves[:, 1:].mean(0)
    waves /= np.linalg.norm(waves, axis=0)
    return np.asarray(np.kron(waves, waves), np.float64)


def update_atoms(dictionary: Array, codes: Array, patches: Array) -> None:
    """Improve every atom and its coefficients in place.

    Args:
        dictionary: columns of length 1, ``(d, K)``.
        codes: coefficients ``(K, N)``.
        patches: what they stand for, ``(d, N)``.
    """
    for atom in range(dictionary.shape[1]):
        users = np.flatnonzero(codes[atom])
        if users.size == 0:
            continue

        coefficients = codes[atom, users]
        codes[atom, users] = 0.0
        residual = patches[:, users] - dictionary @ codes[:, users]
        direction = residual @ coefficients
        length = np.linalg.norm(direction)
        if length > 0.0:
            dictionary[:, atom] = direction / length
        codes[atom, users] = dictionary[:, atom] @ residual


@FILTERS.register("KSVD")
class KSVD(Classical):
    """K-SVD (Elad and Aharon, TIP 2006) with scikit-learn's pursuit, which takes an hour or two a packed megapixel."""

    smallest = 16
    needs = ("sklearn",)
    extra = "ksvd"

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, C)``, C = 3 or 4, in luminance and differences of colour."""
        opponent = to_opponent(planes).transpose(2, 0, 1)
        cleaned = [self._plane(np.ascontiguousarray(plane)) for plane in opponent]
        return from_opponent(np.stack(cleaned, axis=2))

    def _plane(self, plane: Planes) -> Planes:
        image = torch.from_numpy(plane)[None]
        every = extract_patches(image, SIDE)[0]

        corners = patch_grid(plane.shape[0], plane.shape[1], SIDE, STEP)
        patches = every[:, corners].double().numpy()
        mean = patches.mean(0, keepdims=True)
        centred = patches - mean

        dictionary = self._learn(centred)
        estimate = mean + dictionary @ self._code(dictionary, centred)

        sums = torch.zeros_like(every)[None]
        weights = torch.zeros_like(sums[:, :1])
        sums[0][:, corners] = torch.from_numpy(estimate).float()
        weights[0][:, corners] = 1.0
        return assemble(sums, weights, image, SIDE)[0].numpy()

    def _learn(self, patches: Array) -> Array:
        """Learn a dictionary from a part of the patches ``(d, N)``, evenly spaced."""
        spacing = max(1, patches.shape[1] // TRAINING_PATCHES)
        sample = patches[:, ::spacing]
        dictionary = overcomplete_cosines()
        for _ in range(ROUNDS):
            codes = self._code(dictionary, sample)
            update_atoms(dictionary, codes, sample)
        return dictionary

    def _code(self, dictionary: Array, patches: Array) -> Array:
        """Code patches ``(d, N)`` with few atoms, ``(K, N)``."""
        pursuit = self.library("sklearn.linear_model").orthogonal_mp_gram
        tolerance = (GAIN * self.strength * SIDE) ** 2
        energies = (patches**2).sum(0)
        codes = np.zeros((dictionary.shape[1], patches.shape[1]))

        # A patch that its mean explains needs no atom, and most patches of smooth pictures are of this kind.
        hard = np.flatnonzero(energies > tolerance)
        if hard.size == 0:
            return codes

        gram = dictionary.T @ dictionary
        products = dictionary.T @ patches[:, hard]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # atoms that depend on each other end a pursuit early
            sparse = pursuit(gram, products, tol=tolerance, norms_squared=energies[hard])
        codes[:, hard] = np.asarray(sparse).reshape(dictionary.shape[1], -1)
        return codes
