"""The pictures of the paper's page: RAW of a frame by every method, at one exposure, and RAWs drawn of its picture."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame, read_picture
from rawaug.isp.model import DictionaryISP
from rawaug.paper.pictures import SAMPLES, draw_frame

PAIR = Pair(
    "frame",
    RawFrame(0.2 * torch.rand(1, 300, 280, generator=torch.Generator().manual_seed(1)), CFA.RGGB),
    torch.randint(256, (3, 300, 280), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)),
)


def test_a_method_without_error_looks_as_the_raw_and_a_darker_one_darker(tmp_path: Path) -> None:
    def truth(patch: torch.Tensor, share: float) -> torch.Tensor:
        for top in range(0, 45, 2):
            for left in range(0, 25, 2):
                if torch.equal(PAIR.srgb[:, top : top + 256, left : left + 256], patch[0]):
                    return share * PAIR.clean.mosaic[None, :, top : top + 256, left : left + 256]
        raise AssertionError("the patch is no part of the frame at a site of its pattern")

    for name, share in (("exact", 1.0), ("dark", 0.5)):
        method: Any = SimpleNamespace(reverse=lambda patch, setting, share=share: truth(patch, share))
        draw_frame(name, method, PAIR, tmp_path)
    exact, dark, raw = (read_picture(tmp_path / f"{name}.png").float() for name in ("exact", "dark", "RAW"))
    assert torch.equal(exact, raw) and dark.mean() < 0.8 * raw.mean()
    assert raw.mean() > 100, "dark RAW is shown bright"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["RAW.png", "RGB.png", "dark.png", "exact.png"]


def test_the_raws_of_one_picture_stand_side_by_side(tmp_path: Path) -> None:
    draw_frame("ours", DictionaryISP.from_pretrained("universal"), PAIR, tmp_path)
    strip = read_picture(tmp_path / "ours-samples.png")
    assert strip.shape == (3, 128, SAMPLES * 128)
    assert len({panel.float().mean().item() for panel in strip.split(128, dim=-1)}) == SAMPLES
