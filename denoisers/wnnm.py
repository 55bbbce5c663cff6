r"""Weighted nuclear norm minimisation (Gu et al., CVPR 2014; IJCV 2017).

Patches that are alike are the columns of a matrix Y, which without noise has a low rank. Its estimate X minimises
:math:`|Y - X|_F^2 / \sigma^2 + \sum_i w_i s_i(X)` with weights :math:`w_i = c \sqrt{n} / (s_i(X) + \epsilon)`, n being
the number of patches. It has the singular vectors of Y and the singular values

.. math:: s_i(X) = \frac{s_i - \epsilon + \sqrt{(s_i + \epsilon)^2 - 4 C}}{2}, \qquad C = 2 c \sqrt{n} \sigma^2

or 0 if the root is not real. Large values, which are the picture, shrink less than small ones. Estimates are averaged
where patches overlap. A tenth of the difference to the noisy picture is then given back, and everything is repeated
with the noise that is left.

The settings are the published ones for noise of up to 20 / 255. The colours are filtered as luminance and differences;
patches are matched on the luminance.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from denoisers.classical import FILTERS, Classical, Planes, from_opponent, to_opponent
from denoisers.patches import assemble, extract_patches, match_patches, patch_grid

SIDE, STEP, REACH = 6, 2, 12
"""These are the side of a patch, the distance of the patches with groups, and a group's reach, in packed pixels."""
PATCHES = 70
"""A group has this many patches in the first rounds."""
ROUNDS = 8
"""There are this many rounds."""
ROUNDS_A_MATCH = 2
"""Groups are formed again, with fewer patches, after this many rounds."""
FEWER = 10
"""A group shrinks by this many patches whenever groups are formed again."""
GIVEN_BACK = 0.1
"""This share of the difference to the noisy picture is given back before a round."""
NOISE_LEFT = 0.54
"""This factor of the noise is estimated to be left after a round."""
WEIGHT = 2.0 * math.sqrt(2.0)
"""This is c, the published factor of the weights."""
EPS = 1e-6


def shrink(values: Tensor, noise: Tensor, patches: int) -> Tensor:
    """Shrink the singular values of noisy groups to those of the estimate.

    Args:
        values: singular values of the noisy groups ``(..., k)``.
        noise: deviation of the noise of each group ``(...)``.
        patches: n, the number of patches of a group.

    Example:
        >>> shrink(torch.tensor([200.0, 12.0]), torch.tensor(1.0), patches=64)
        tensor([199.7735,   0.0000])
    """
    threshold = 2.0 * WEIGHT * math.sqrt(patches) * noise.square()[..., None]
    root = (values + EPS).square() - 4.0 * threshold
    shrunk = 0.5 * (values - EPS + root.clamp_min(0.0).sqrt())
    return torch.where(root > 0.0, shrunk, 0.0)


def denoise_groups(groups: Tensor, noise: Tensor) -> Tensor:
    """Estimate groups ``(R, d, n)`` of n patches of d values, whose noise has the deviations ``(R,)``."""
    mean = groups.mean(2, keepdim=True)
    centred = groups - mean

    # The eigenvectors of Y Y^T are the left singular vectors of Y, and are found faster.
    squares, vectors = torch.linalg.eigh(centred @ centred.mT)
    values = squares.clamp_min(0.0).sqrt()
    factors = shrink(values, noise, groups.shape[2]) / values.clamp_min(EPS)
    return mean + vectors @ (factors[..., None] * (vectors.mT @ centred))


@FILTERS.register("WNNM")
class WNNM(Classical):
    """Weighted nuclear norm minimisation (Gu et al., CVPR 2014), which takes about 40 minutes a packed megapixel."""

    smallest = 16

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, C)``, C = 3 or 4, in luminance and differences of colour."""
        noisy = torch.from_numpy(to_opponent(planes)).permute(2, 0, 1).contiguous()
        corners = patch_grid(noisy.shape[1], noisy.shape[2], SIDE, STEP)
        noisy_patches = extract_patches(noisy, SIDE)

        estimate = noisy
        for round_index in range(ROUNDS):
            estimate = estimate + GIVEN_BACK * (noisy - estimate)
            if round_index % ROUNDS_A_MATCH == 0:
                count = PATCHES - FEWER * (round_index // ROUNDS_A_MATCH)
                groups = match_patches(estimate[0], corners, SIDE, REACH, count)

            patches = extract_patches(estimate, SIDE)
            difference = (noisy_patches - patches).square().mean(1)
            noise = NOISE_LEFT * (self.strength**2 - difference).abs().sqrt()
            if round_index == 0:
                noise = torch.full_like(noise, self.strength)
            estimate = self._round(estimate, patches, noise[:, corners], groups)

        return from_opponent(estimate.permute(1, 2, 0).numpy())

    def _round(self, estimate: Tensor, patches: Tensor, noise: Tensor, groups: Tensor) -> Tensor:
        """Run one round on a picture ``(C, h, w)``; ``noise`` is ``(C, R)``, ``groups`` ``(R, n)``."""
        sums = torch.zeros_like(patches)
        weights = torch.zeros_like(patches[:, :1])
        ones = torch.ones(groups.numel())

        for channel, values in enumerate(patches):
            members = values[:, groups].permute(1, 0, 2)  # (R, d, n)
            cleaned = denoise_groups(members, noise[channel])
            sums[channel].index_add_(1, groups.flatten(), cleaned.permute(1, 0, 2).flatten(1))
            weights[channel, 0].index_add_(0, groups.flatten(), ones)
        return assemble(sums, weights, estimate, SIDE)
