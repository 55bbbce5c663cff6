r"""Noise of a camera by name: darktable's profiles, 374 models by ISO.

.. math:: \operatorname{var}(y) = \mathrm{shot\_var} \cdot y + \mathrm{read\_var}

of black-subtracted RAW, white 1. The ISO is drawn log-uniformly between the ends of a camera's profile, and both
variances are interpolated in their logarithms against that of the ISO. Two things about the profiles:

- The red and blue figures differ from the green ones as if they contained a white balance (a gain w multiplies a by w
  and b by w squared), so the green ones are taken for all channels: photons and electronics are the same behind every
  filter.
- darktable measures after demosaicking and on fine details, where noise has been averaged. For four cameras that ELD
  (Wei et al., CVPR 2020) measured on the mosaic the profiles are too low, by 7.2 to 11.4 in shot variance and 2.2 to
  16 in read variance; all are multiplied by the geometric means, :data:`SHOT_ON_MOSAIC` and :data:`READ_ON_MOSAIC`.
  The median of shot_var at ISO 100 is then 2.8e-5, a full well of 36,000 electrons.

Rows whose green variance is not positive are left out, and counted in :attr:`Profiles.rows_left_out`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.camera_names import spelled
from rawaug.noise.iso import Iso, iso_limits

ANY_CAMERA = "any camera"
SHOT_ON_MOSAIC = 8.6
READ_ON_MOSAIC = 6.2


class Profiles(NamedTuple):
    """The usable rows of all cameras.

    Args:
        names: maker and model, ``N`` of them.
        table: ``(3, N, R)`` float64, logarithms of ISO, shot_var and read_var, ISO increasing; behind a camera's
            last row the ISO is infinite and the logarithms of the variances are 0.
        rows: ``(N,)`` number of each camera's rows.
        rows_left_out: rows of the profiles with a variance that is not positive.
        cameras_left_out: cameras with no other row.
    """

    names: tuple[str, ...]
    table: Tensor
    rows: Tensor
    rows_left_out: int
    cameras_left_out: tuple[str, ...]

    def limits(self) -> Tensor:
        """Logarithms of the lowest and highest ISO of each camera, ``(N, 2)``."""
        iso = self.table[0]
        return torch.stack([iso[:, 0], iso.gather(1, self.rows[:, None] - 1)[:, 0]], dim=1)


@cache
def published_profiles() -> Profiles:
    """The package's ``profiles.tsv``. Where a camera has an ISO twice the geometric mean is taken."""
    cameras: dict[str, dict[float, list[tuple[float, float]]]] = {}
    left_out = 0
    text = resources.files("rawaug.noise").joinpath("profiles.tsv").read_text("utf-8")
    for line in text.splitlines()[2:]:
        maker, model, iso, *variances = line.split("\t")
        rows = cameras.setdefault(f"{maker} {model}", defaultdict(list))
        shot_var, read_var = float(variances[1]) * SHOT_ON_MOSAIC, float(variances[4]) * READ_ON_MOSAIC
        if shot_var > 0 and read_var > 0:
            rows[math.log(float(iso))].append((math.log(shot_var), math.log(read_var)))
        else:
            left_out += 1
    names = tuple(name for name, rows in cameras.items() if rows)
    length = torch.tensor([len(cameras[name]) for name in names])
    table = torch.zeros(3, len(names), int(length.max()), dtype=torch.float64)
    table[0] = math.inf
    for camera, name in enumerate(names):
        for row, (log_iso, levels) in enumerate(sorted(cameras[name].items())):
            means = torch.tensor(levels, dtype=torch.float64).mean(dim=0)
            table[:, camera, row] = torch.tensor([log_iso, *means.tolist()], dtype=torch.float64)
    return Profiles(names, table, length, left_out, tuple(name for name, rows in cameras.items() if not rows))


def profile_names() -> list[str]:
    """The cameras that have a profile."""
    return list(published_profiles().names)


class ProfileLevels:
    """Levels of one camera, or of any, each weighted alike.

    Args:
        camera: maker and model, whatever the case of the letters, or ``"any camera"``.
        iso: one ISO, limits, or None for the whole profile. Of ``"any camera"``, whose profiles end at different ISOs,
            every camera keeps its share of the limits; one without a share is not drawn.

    Attributes:
        cameras: indices into :func:`published_profiles` of those that are drawn, ``(M,)``.
        limits: logarithms of their lowest and highest ISO, ``(M, 2)``.

    Raises:
        ValueError: if the camera is unknown, or the ISO outside what was measured.

    Example:
        >>> shot_var, read_var = ProfileLevels("Sony ILCE-7M3", iso=800).sample(1, torch.Generator())
        >>> round(shot_var.item(), 7)
        6.72e-05
    """

    def __init__(self, camera: str = ANY_CAMERA, iso: Iso = None) -> None:
        profiles = published_profiles()
        limits = profiles.limits()
        if camera.casefold() == ANY_CAMERA:
            measured = (round(math.exp(limits.min())), round(math.exp(limits.max())))
            wanted = torch.tensor(iso_limits(ANY_CAMERA, iso, measured), dtype=torch.float64).log()
            limits = torch.stack([limits[:, 0].clamp_min(wanted[0]), limits[:, 1].clamp_max(wanted[1])], dim=1)
            self.cameras = (limits[:, 0] <= limits[:, 1] + _ROUNDING).nonzero()[:, 0]
        else:
            index = profiles.names.index(spelled(camera, profiles.names))
            low, high = (round(value) for value in limits[index].exp().tolist())
            limits[index] = torch.tensor(iso_limits(profiles.names[index], iso, (low, high)), dtype=torch.float64).log()
            self.cameras = torch.tensor([index])
        if not len(self.cameras):
            raise ValueError(f"no camera has a profile within ISO {iso}; widen the range")
        self.limits = limits[self.cameras]

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        device = generator.device
        drawn = torch.randint(len(self.cameras), (batch,), generator=generator, device=device)
        low, high = self.limits.to(device)[drawn].unbind(1)
        at = low + (high - low) * torch.rand(batch, generator=generator, device=device, dtype=torch.float64)
        iso, shot, read = published_profiles().table.to(device)[:, self.cameras.to(device)[drawn]]
        right = torch.searchsorted(iso, at[:, None]).clamp(1, iso.shape[1] - 1)
        (x0, x1), (s0, s1), (r0, r1) = ((y.gather(1, right - 1), y.gather(1, right)) for y in (iso, shot, read))
        t = ((at[:, None] - x0) / (x1 - x0)).clamp(0.0, 1.0)
        return torch.exp(torch.lerp(s0, s1, t))[:, 0].float(), torch.exp(torch.lerp(r0, r1, t))[:, 0].float()


_ROUNDING = 1e-9
"""Of logarithms that are the same ISO."""
