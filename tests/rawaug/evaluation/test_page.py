"""The page of a run: it stands alone, says what was measured, and its pictures are pictures."""

from __future__ import annotations

import base64
import csv
import io
import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.figures import WINDOW, Panels, find_detail, plot_curves
from rawaug.evaluation.page import Page, name_part
from rawaug.evaluation.table_files import latex_table
from rawaug.evaluation.trials import raw_trial
from rawaug.evaluation.verdict import verdict
from rawaug.io import RawFrame


def scores(psnr: float) -> dict[str, Any]:
    keys = {"psnr": psnr, "ssim": 0.91, "psnr_srgb": 30.0, "ssim_srgb": 0.8}
    quarters = {f"{key}_{part}": value for key, value in keys.items() for part in ("worst25", "best25")}
    noisy = {f"{key}_noisy": 0.5 for key in keys}
    image = {"name": "a <frame>", "shot_var": 1e-3, **keys, **noisy}
    return {"images": [image, image], **keys, **quarters, **noisy}


@pytest.fixture
def page(tmp_path: Path) -> str:
    log = tmp_path / "log.csv"
    log.write_text("step,loss,psnr,samples_per_second\n2,0.1,30,9\n4,0.05,31,9\n")
    results = {"real": [{"plain": scores(40.123), "self_ensemble": scores(41.0)}]}
    others = {"Wavelet": scores(37.5)}
    made = Page("a & b", verdict(results, others).sentence)
    made.add_facts({"Noise": "upi"}, results)
    made.add("Methods", terms={"real": "a U-Net"})
    made.add_scores(results, others)
    made.add_curves(plot_curves({"real": [log]}))
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(1, 200, 800, generator=generator)
    frame = RawFrame(raw, CFA.GRBG, white_balance=(2, 1, 1.6))
    pair = Pair("a <frame>", frame, torch.zeros(3, 200, 800, dtype=torch.uint8))
    packed = bayer.pack(raw[None], CFA.GRBG)
    trial = raw_trial(pair, packed, packed, packed, None, CFA.GRBG)
    made.add_frame(Panels(trial, {"noisy": packed, "real": packed, "clean": packed}, {"real": "40.12 dB"}))
    return made.write(tmp_path / "new" / "report.html", {"steps": 4}).read_text(encoding="utf-8")


def test_it_stands_alone_and_says_what_was_measured(page: str) -> None:
    assert not re.search(r"(?:src|href)=[\"'](?!data:)", page), "nothing is fetched"
    assert all(page.count(f"<{tag}") == page.count(f"</{tag}>") for tag in ("table", "figure", "dl", "h2", "body"))
    text = unescape(re.sub(r"<[^>]*>", "", page))
    for said in ("a & b", "a <frame>", "40.12", "37.50", "41.00", "Wavelet", "worst 25%", "steps: 4", "noisy input"):
        assert said in text


def test_it_opens_with_the_verdict_and_marks_the_best(page: str) -> None:
    assert "Use real: +2.62 dB over Wavelet, between +2.62 and +2.62 by 2 frames and 1 seed" in page
    assert "a U-Net" in page and "else upi; shot_var 0.001" in page
    cells = re.findall(r'<td class="best">([^<]*)', page)
    assert "40.12" in cells and "37.50" not in cells and "41.00" not in cells  # the only self-ensemble is no best one
    heads = re.findall(r"<thead>.*?</thead>", page, re.DOTALL)
    assert [head.count("self-ensemble") for head in heads] == [0, 0, 0, 0]  # a heading of its own says so


def test_its_pictures_open_and_have_the_promised_sizes(page: str) -> None:
    images = re.findall(r'<img alt="([^"]+)" src="data:image/png;base64,([^"]+)">', page)
    assert len(images) == page.count("<img")
    sizes = [Image.open(io.BytesIO(base64.b64decode(png))).size for _, png in images]
    assert sizes[2:] == [(2 * WINDOW, 2 * WINDOW)] * 3 + [(640, 160)]


def test_the_window_is_where_the_detail_is() -> None:
    packed = torch.full((1, 4, 200, 300), 0.2)
    packed[..., 120:150, 200:240] = torch.rand(30, 40, generator=torch.Generator().manual_seed(0))
    top, left = find_detail(packed)
    assert top <= 120 and top + WINDOW >= 150 and left <= 200 and left + WINDOW >= 240
    assert find_detail(packed[..., :20, :30]) == (0, 0)


def test_a_curve_of_one_point_is_seen(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("step,loss,psnr\n4,0.1,30\n")
    pictures = plot_curves({"real": [tmp_path / "log.csv"]})
    assert set(pictures) == {"loss", "validation PSNR (dB)"}
    for png in pictures.values():
        pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
        legend_alone = 60  # pixels of the line beside the arm's name
        assert (pixels == (31, 119, 180)).all(axis=2).sum() > legend_alone + 20


@pytest.mark.filterwarnings("error")
def test_a_loss_below_0_is_drawn(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("step,loss,psnr\n4,0.1,30\n8,-0.3,31\n")
    assert "loss" in plot_curves({"real": [tmp_path / "log.csv"]})


def test_its_tables_lie_beside_it_as_csv_and_latex(page: str, tmp_path: Path) -> None:
    with (tmp_path / "new" / "report_scores.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head[1] == "PSNR (dB)" and [row[:2] for row in rows if row[0] == "real"] == [["real", "40.12"]]
    text = (tmp_path / "new" / "report_scores.tex").read_text()
    assert "\\textbf{40.12}" in text and text.count("\\\\") == len(rows) + 1
    assert (tmp_path / "new" / "report_every_image.tex").is_file()
    assert latex_table(["", "a_b"], {"50 % & more": ["1"]}).count("\\") > 6


def test_no_name_of_a_file_is_a_formula_in_a_spreadsheet(tmp_path: Path) -> None:
    rows = {name: ["1"] for name in ("=cmd|' calc'!A1", "+1", "-1", "@x", "\t=1", "a=b")}
    page = Page("title")
    page.add("Scores", head=["", "+PSNR"], rows=rows)
    page.write(tmp_path / "r.html", {})
    with (tmp_path / "r_scores.csv").open(newline="") as file:
        head, *table = csv.reader(file)
    names = [head[1], *(row[0] for row in table)]
    assert len(names) == 7 and not any(name.startswith(("=", "+", "-", "@", "\t")) for name in names)


def test_a_middle_is_not_called_a_whole_frame(page: str) -> None:
    assert "whole frame, 800 x 200, clean" in page
    assert name_part(512, 512, crop=512) == "middle, 512 x 512"
    assert name_part(300, 512, crop=512) == "middle, 512 x 300"
