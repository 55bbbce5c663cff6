r"""Noise profiles of 369 cameras by ISO, var = a y + b, as measured by darktable.

Their red and blue figures contain a white balance, so the green ones serve all channels. darktable measures after
demosaicing, which averages noise. For four cameras that ELD measured on the mosaic, darktable's profiles are too low by
7.2 to 11.4 in shot variance and 2.2 to 16 in read variance. All profiles are multiplied by the geometric means,
:data:`SHOT_ON_MOSAIC` and :data:`READ_ON_MOSAIC`; the median shot_var at ISO 100 is then 2.8e-5, a full well of 36,000
electrons. A fifth camera supports the first factor: frames of a Nikon D5000 at ISO 200 measure 2.6 to 3.2e-5, and its
profile gives 3.09e-5. A sixth, Raspberry Pi's IMX477, has 6.0, below the others; all six make :data:`SPREAD`. ``any
camera`` draws the two factors independently, log-uniformly over the spread. Rows whose green variance is not positive
are left out.

Raspberry Pi's tuning file (libcamera, src/ipa/rpi/vc4/data/imx477.json) states the standard deviation over the root of
the signal above black at gain 1, in numbers of 16 bits: 2.767. With white 65535 and black 4096, shot_var is 2.767^2 /
61439 = 1.25e-4, which is 6.0 times the profile at ISO 100.
"""

from __future__ import annotations

import math
from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rawaug.camera.names import find_camera
from rawaug.noise.levels import Iso, iso_limits, log_uniform

ANY_CAMERA = "any camera"
"""The name that stands for all profiles together."""

SHOT_ON_MOSAIC = 8.6
"""Ratio of the shot variance on the mosaic to that of a profile."""
READ_ON_MOSAIC = 6.2
"""Ratio of the read variance on the mosaic to that of a profile."""

SPREAD = ((6.0 / SHOT_ON_MOSAIC, 11.4 / SHOT_ON_MOSAIC), (2.2 / READ_ON_MOSAIC, 16.0 / READ_ON_MOSAIC))
"""Limits of a camera's shot_var and read_var, relative to those of its profile: those of six cameras."""

_ROUNDING = 1e-9
"""Largest difference between logarithms that count as one ISO."""


class Profiles(NamedTuple):
    """The usable rows of darktable's N cameras.

    Args:
        names: maker and model of each camera.
        table: float64 ``(3, N, R)``, logarithms of ISO, shot_var and read_var; ISO ascends, and is infinite after a
            camera's last row.
        rows: ``(N,)`` number of rows of each camera.
    """

    names: tuple[str, ...]
    table: Tensor
    rows: Tensor

    def limits(self) -> Tensor:
        """The logarithms of the lowest and highest ISO of each camera, ``(N, 2)``."""
        log_iso = self.table[0]
        last = log_iso.gather(1, self.rows[:, None] - 1)
        return torch.cat([log_iso[:, :1], last], dim=1)


@cache
def load_profiles() -> Profiles:
    """Load the package's ``profiles.tsv``; if a camera has an ISO twice, their geometric mean is used."""
    cameras: dict[str, dict[float, list[list[float]]]] = {}
    text = resources.files("rawaug.noise").joinpath("profiles.tsv").read_text("utf-8")
    for line in text.splitlines()[2:]:
        maker, model, iso, *variances = line.split("\t")
        shot_var = float(variances[1]) * SHOT_ON_MOSAIC
        read_var = float(variances[4]) * READ_ON_MOSAIC

        if min(shot_var, read_var) > 0:
            levels_by_iso = cameras.setdefault(f"{maker} {model}", {})
            levels = levels_by_iso.setdefault(math.log(float(iso)), [])
            levels.append([math.log(shot_var), math.log(read_var)])

    tables = [_profile_rows(levels_by_iso) for levels_by_iso in cameras.values()]
    rows = torch.tensor([len(table) for table in tables])
    table = pad_sequence(tables, batch_first=True).permute(2, 0, 1).contiguous()
    is_padding = torch.arange(table.shape[2]) >= rows[:, None]
    table[0, is_padding] = math.inf
    return Profiles(tuple(cameras), table, rows)


def _profile_rows(levels_by_iso: dict[float, list[list[float]]]) -> Tensor:
    """Make rows of log ISO, log shot_var and log read_var, ``(R, 3)``, in ascending order of ISO."""
    rows = []
    for log_iso, levels in sorted(levels_by_iso.items()):
        mean = levels[0]
        if len(levels) > 1:
            mean = torch.tensor(levels, dtype=torch.float64).mean(dim=0).tolist()
        rows.append([log_iso, *mean])
    return torch.tensor(rows, dtype=torch.float64)


class ProfileLevels:
    """The levels of one camera's profile, or of all profiles with equal probability.

    Each picture draws an ISO, log-uniformly within the range of its camera's profile. For ``any camera`` the levels are
    drawn within :data:`SPREAD` as well; for one camera they are the middle of it.

    Args:
        camera: maker and model, or ``any camera``.
        iso: one ISO, the limits of the draw, or None for the whole measured range.

    Raises:
        ValueError: if the camera has no profile, or no profile reaches the ISO.
    """

    def __init__(self, camera: str = ANY_CAMERA, iso: Iso = None) -> None:
        profiles = load_profiles()
        self.spread = camera.casefold() == ANY_CAMERA

        label, names = ANY_CAMERA, profiles.names
        if not self.spread:
            label = find_camera(camera, profiles.names)
            names = (label,)
        cameras = torch.tensor([profiles.names.index(name) for name in names])

        limits = profiles.limits()[cameras]
        lowest, highest = float(limits.min()), float(limits.max())
        iso_range = (round(math.exp(lowest)), round(math.exp(highest)))
        low, high = torch.tensor(iso_limits(label, iso, iso_range), dtype=torch.float64).log()
        limits = torch.stack([limits[:, 0].clamp_min(low), limits[:, 1].clamp_max(high)], dim=1)

        within = limits[:, 0] <= limits[:, 1] + _ROUNDING
        if not within.any():
            raise ValueError(f"no camera has a profile within ISO {iso}; widen the range")
        self.cameras, self.limits = cameras[within], limits[within]

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw a camera and an ISO for each picture, and interpolate its levels, ``(batch,)``."""
        drawn = self.draw(batch, generator)
        return drawn["shot_var"], drawn["read_var"]

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``iso``, ``shot_var`` and ``read_var``, ``(batch,)``."""
        device = generator.device
        camera = torch.randint(len(self.cameras), (batch,), generator=generator, device=device)
        low, high = self.limits.to(device)[camera].unbind(1)
        log_iso = low + (high - low) * torch.rand(batch, generator=generator, device=device, dtype=torch.float64)

        table = load_profiles().table.to(device)
        log_isos, log_shot, log_read = table[:, self.cameras.to(device)[camera]]
        right = torch.searchsorted(log_isos, log_iso[:, None]).clamp(1, log_isos.shape[1] - 1)
        left_iso, right_iso = log_isos.gather(1, right - 1), log_isos.gather(1, right)
        weight = ((log_iso[:, None] - left_iso) / (right_iso - left_iso)).clamp(0.0, 1.0)

        shot_var = _interpolate(log_shot, right, weight)
        read_var = _interpolate(log_read, right, weight)
        if self.spread:
            shot_var = shot_var * log_uniform(SPREAD[0], batch, generator)
            read_var = read_var * log_uniform(SPREAD[1], batch, generator)
        return {"iso": log_iso.exp().float(), "shot_var": shot_var, "read_var": read_var}


def _interpolate(log_levels: Tensor, right: Tensor, weight: Tensor) -> Tensor:
    """Interpolate levels ``(B,)`` between the columns ``right - 1`` and ``right`` of rows ``(B, R)`` of logarithms."""
    log_level = torch.lerp(log_levels.gather(1, right - 1), log_levels.gather(1, right), weight)
    return torch.exp(log_level)[:, 0].float()


class LevelEnds(NamedTuple):
    """The lowest and the highest levels that one camera is likely to have at an ISO, white = 1."""

    iso: float
    shot_var: tuple[float, float]
    read_var: tuple[float, float]


def profile_ends(camera: str) -> list[LevelEnds]:
    """Say how well the levels of a camera's profile are known, at its lowest ISO and at each doubling of it.

    Raises:
        ValueError: if the camera has no profile.

    Example:
        >>> iso, shot_var, _ = profile_ends("Sony ILCE-7M3")[0]
        >>> f"ISO {iso:g}: {shot_var[0]:.1e} to {shot_var[1]:.1e}"
        'ISO 100: 8.4e-06 to 1.6e-05'
    """
    low, high = map(round, ProfileLevels(camera).limits[0].exp().tolist())
    doublings = int(math.log2(high / low))

    ends = []
    for doubling in range(doublings + 1):
        iso = float(low * 2**doubling)
        shot_var, read_var = map(float, ProfileLevels(camera, iso).sample(1, torch.Generator()))
        (low_shot, high_shot), (low_read, high_read) = SPREAD
        shot_ends = (shot_var * low_shot, shot_var * high_shot)
        ends.append(LevelEnds(iso, shot_ends, (read_var * low_read, read_var * high_read)))
    return ends
