from __future__ import annotations

import numpy as np
import pytest

from rawaug.bayer import pattern, plane_indices
from rawaug.io.masked import MaskedPixels, measure_masked

WINDOW = (6, 12, 100, 160)
LEVELS = (31.0, 32.5, 33.0, 34.2)


def a_sensor(cfa: str, levels: tuple[float, ...] = LEVELS, window: tuple[int, ...] = WINDOW) -> np.ndarray:
    """Digital numbers of a bright picture with masked margins, 12 left, 52 right and 6 above, noise of 3 numbers."""
    top, left, height, width = window
    kinds, rng = plane_indices(cfa).numpy(), np.random.default_rng(0)
    rows, columns = (np.arange(size) - first for size, first in ((top + height, top), (left + width + 52, left)))
    kind = kinds[rows[:, None] % len(kinds), columns % len(kinds)]
    dark = np.asarray(levels)[kind] + 3 * rng.standard_normal(kind.shape)
    dark[top : top + height, left : left + width] += 300
    return dark.round().astype(np.uint16)


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "XTRANS", "XTRANS+1+2", "QUAD-RGGB"])
@pytest.mark.parametrize("window", [WINDOW, (7, 13, 100, 160)])
def test_masked_pixels_tell_the_level_of_each_colour(cfa: str, window: tuple[int, int, int, int]) -> None:
    found = measure_masked(a_sensor(cfa, window=window), window, cfa)
    assert found is not None and 0.02 < found.error < 0.2
    one_green = len(np.unique(plane_indices(cfa))) == 3
    expected = LEVELS if not one_green else (LEVELS[0], LEVELS[1], LEVELS[1], LEVELS[3])
    assert np.abs(np.subtract(found.black, expected)).max() < 4 * found.error
    assert pattern(cfa).period and found.corrects((32, 32, 32, 32), 1023)
    assert not found.corrects(found.black, 1023)


def test_outliers_in_the_margin_are_left_out() -> None:
    numbers = a_sensor("RGGB")
    numbers[::7, -40::9] = 1023  # hot pixels
    found = measure_masked(numbers, WINDOW, "RGGB")
    assert found is not None and np.abs(np.subtract(found.black, LEVELS)).max() < 4 * found.error


def test_margins_that_disagree_are_not_trusted() -> None:
    numbers = a_sensor("RGGB", (34, 34, 34, 34))
    numbers[:56, 172:] += 6  # lit above
    found = measure_masked(numbers, WINDOW, "RGGB")
    assert found is not None and found.spread > 2 and not found.corrects((32, 32, 32, 32), 1023)


def test_levels_that_no_camera_is_wrong_by_are_not_trusted() -> None:
    found = MaskedPixels((52, 52, 52, 52), error=0.01, spread=0.1, sites=1000)
    assert not found.corrects((32, 32, 32, 32), 1023) and found.corrects((50, 50, 50, 50), 1023)
    assert not MaskedPixels((33, 33, 33, 33), error=0.4, spread=0.1, sites=9).corrects((32, 32, 32, 32), 1023)


def test_dummies_clipped_and_narrow_margins_tell_nothing() -> None:
    numbers = a_sensor("RGGB")
    assert measure_masked(numbers[6:, 12:-52], (0, 0, 100, 160), "RGGB") is None
    assert measure_masked(numbers[:, 5:-46], (6, 7, 100, 160), "RGGB") is None
    assert measure_masked(a_sensor("RGGB", (1, 1, 1, 1)).clip(0, 9), WINDOW, "RGGB") is None
    dummies = numbers.copy()
    dummies[:, :12], dummies[:, 172:] = 32, 32
    assert measure_masked(dummies, WINDOW, "RGGB") is None
