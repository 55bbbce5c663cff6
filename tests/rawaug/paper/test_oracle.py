"""The oracle of the reconstruction table is the best of all rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.paper import methods as search
from rawaug.paper.methods import dictionary_params, oracle, squared_error
from rawaug.seeding import keyed_generator


@pytest.fixture(scope="module")
def published() -> DictionaryISP:
    return DictionaryISP.from_pretrained("universal-small")


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "STEPS", 30)
    monkeypatch.setattr(search, "PIXELS", 2048)


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("seed", [0, 1])
def test_no_row_that_knows_less_is_better(published: DictionaryISP, frame_of: Callable[..., Pair], seed: int) -> None:
    setting = published.draw_setting(1, keyed_generator(seed))
    frame = frame_of(f"drawn {seed}")
    with torch.no_grad():
        raw = (published.reverse(frame.srgb[None], setting).raw[0] * 1023.0).round() / 1023.0
    frame = replace(frame, raw=raw, cfa=CFA.RGGB, white_balance=tuple(setting.gains[0].tolist()))
    rows = dictionary_params(published, frame)
    pixels, _ = sample_pixels([frame], 4096, seed=7)
    errors = {row: squared_error(published, pixels, params).item() for row, params in rows.items()}
    assert errors["oracle"] < 1.02 * min(errors.values()), "on other pixels than those that it was chosen by"
    assert errors["oracle"] < 1e-5 < errors["blind"], "it finds camera, light and tone at once: 50 dB"


@pytest.mark.usefixtures("brief")
def test_a_better_guess_is_taken(published: DictionaryISP, frame_of: Callable[..., Pair]) -> None:
    setting = published.draw_setting(1, keyed_generator(5))
    frame = frame_of("exact")
    with torch.no_grad():
        frame = replace(frame, raw=published.reverse(frame.srgb[None], setting).raw[0], cfa=CFA.RGGB)
    other = published.draw_setting(1, keyed_generator(6))
    assert torch.equal(oracle(published, frame, [other, setting]).matrix, setting.matrix)
