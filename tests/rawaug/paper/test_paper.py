"""The page of the paper's tables: figures of parts beside the paper's, in its order, whatever parts were run."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug.commands.run import with_values
from rawaug.experiment.recipe import find_recipe, read_recipe
from rawaug.files import write_bytes
from rawaug.io.pictures import encode_png
from rawaug.paper import published
from rawaug.paper.order import compare_order, order_sentence
from rawaug.paper.paper import PARTS, Paper, read_tables, run_paper, still_falling

ROW = {"parameters": 590_000, "seconds": 1.0, "mpix_s": 1.0}


def write(folder: Path, part: str, stem: str, content: dict[str, Any]) -> None:
    (folder / part).mkdir(parents=True, exist_ok=True)
    (folder / part / f"{stem}.json").write_text(json.dumps(content))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run whose parts are there but for one of the DSLRs."""
    rows = {
        "upi-tuned": {**ROW, "psnr_r": [30.0], "worst25": [20.0], "best25": [40.0]},
        "unet": {**ROW, "psnr_r": [29.0], "worst25": [20.0], "best25": [40.0], "steps": 100, "curve": [2.0, 1.0, 0.9]},
        "dictionary-encoders": {**ROW, "psnr_r": [41.0, 43.0], "worst25": [25.0, 26.0], "best25": [50.0, 51.0]},
    }
    rows["dictionary-encoders"] |= {"psnr_d": [39.0, 39.5], "cycle": 33.5}
    run = tmp_path / "paper"
    write(run, "table1", "table", {"rows": rows})
    write(
        run, "table2_canon", "table", {"rows": {"invisp, own rendering": {**ROW, "psnr_r": [44.0], "balanced": [45.0]}}}
    )
    plain = {"psnr": 40.0, "ssim": 0.95, "psnr_noisy": 30.0, "ssim_noisy": 0.7}
    ensemble = {"psnr": 40.5, "ssim": 0.955}
    results = {"ours": [{"plain": plain, "self_ensemble": ensemble}], "dhdn": [{"plain": plain}]}
    write(run, "table3", "results", {"results": results, "others": {"WNNM": {"psnr": 38.0, "ssim": 0.9}}})
    log = run / "table3" / "seed0" / "ours" / "log.csv"
    log.parent.mkdir(parents=True)
    log.write_text("step,loss,psnr\n300,0.02,38\n600,0.015,40\n")
    write(run, "few", "results", {"results": {"ours_f": [{"plain": plain}]}, "others": {}})
    stages = {"blind": [[20.0 + k, 21.0 + k, 22.0 + k] for k in range(6)]}
    write(run, "ablation", "ablation", {"stages": stages})
    return run


def test_our_figures_stand_beside_the_papers(folder: Path) -> None:
    found = read_tables(folder)
    first = found["table1"]["dictionary-encoders (Ours)"]
    assert first["PSNR_r"] == [41.0, 43.0] and first["PSNR_r, paper"] == 45.21
    assert first["cycle"] == 33.5 and first["cycle, paper"] == 37.82 and first["M parameters"] == 0.59
    assert found["table1"]["unet (U-Net)"]["loss still falling"] == pytest.approx(10.0)

    second = found["table2"]["invisp, own rendering"]
    assert second["Canon PSNR_r"] == [44.0] and second["Canon balanced"] == [45.0]
    assert not any(column.startswith("Nikon") for column in second), "a camera that was not run"

    third = found["table3"]
    assert list(third) == ["Noisy", "WNNM", "DHDN", "Ours-f", "Ours"], "the paper's order"
    assert third["Ours"]["PSNR"] == [40.5] and third["DHDN"]["PSNR"] == [40.0] and third["Noisy"]["SSIM"] == [0.7]
    assert third["Ours"]["steps"] == 600 and third["Ours"]["loss still falling"] == pytest.approx(25.0)
    assert "steps" not in third["DHDN"], "without a log nothing is said of the training"
    assert found["ablation"]["Y, blind"]["x5 shading"] == 26.0
    assert found["ablation"]["UV, paper"]["x4 gains"] == 47.59


def test_the_order_of_the_rows_is_compared_pair_by_pair(folder: Path) -> None:
    alike, refuted, undecided = compare_order(read_tables(folder)["table1"], "PSNR_r")
    assert alike == 2 and refuted == ["unet (U-Net) above upi-tuned (UPI)"]
    assert "2 of 3 pairs" in order_sentence(alike, refuted, undecided)
    assert order_sentence(*compare_order({}, "PSNR_r")) == ""


def test_an_order_is_found_again_refuted_or_not_decided() -> None:
    table: Any = {
        "a": {"PSNR": [40.0, 40.2, 40.1], "PSNR, paper": 50.0},
        "b": {"PSNR": [39.9, 40.3, 40.0], "PSNR, paper": 49.0},
        "c": {"PSNR": [42.0, 42.2, 42.1], "PSNR, paper": 48.0},
        "d": {"PSNR": [39.0, 39.1, 39.2], "PSNR, paper": 47.0},
    }
    assert compare_order(table, "PSNR") == (3, ["a above c", "b above c"], ["a above b"])
    one_seed: Any = {"a": {"PSNR": 40.0, "PSNR, paper": 50.0}, "b": {"PSNR": 40.05, "PSNR, paper": 49.0}}
    assert compare_order(one_seed, "PSNR")[2] == ["a above b"]


def test_one_page_and_one_file_have_all_of_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paper = Paper(out=str(folder.parent), parts=[])
    for picture in ("table1/shown/RAW", "table1/shown/unet", "few/picture"):
        write_bytes(encode_png(torch.rand(3, 8, 8)), folder / f"{picture}.png")
    (folder / "run.json").write_text(json.dumps(asdict(paper)))
    result = run_paper(paper)
    page = (folder / "report.html").read_text()
    for text in ("Table 1", "Table 2", "Table 3", "Ablation", "45.21", "WNNM", "42.00"):
        assert text in page
    assert page.count("<img") == 3 and "unet (U-Net)</figcaption>" in page
    assert json.loads((folder / "paper.json").read_text())["tables"] == json.loads(json.dumps(result))


def test_the_shipped_recipe_has_every_part_and_takes_the_data_of_the_whole() -> None:
    content = read_recipe(find_recipe("paper"))
    paper = with_values(Paper, {**content, "data": "sidd:A", "test": "sidd:B", "pictures": "C"}, "paper")
    for name in PARTS:
        part = paper.part(name)
        assert part.name == f"paper/{name}"
    assert paper.part("table1").downstream.test == ["sidd:B"] and paper.part("table1").data == "sidd:A"
    assert paper.part("few").data.pairs == "sidd:A" and paper.part("few").data.count == 56
    assert paper.part("ablation").data == "sidd:A"
    assert paper.part("table2_canon").data == "dslr_canon_jpeg:"
    with pytest.raises(ValueError, match="table4"):
        Paper(parts=["table4"])


def test_every_row_of_the_paper_has_one_of_ours() -> None:
    content = read_recipe(find_recipe("paper"))
    first = {published.ISP_NAMES.get(name) for name in content["table1"]["methods"]}
    assert set(published.TABLE_1) <= first
    second = {published.ISP_NAMES.get(name) for name in content["table2_canon"]["methods"]}
    assert set(published.TABLE_2) <= second
    arms = [*content["table3"]["arms"], *content["few"]["arms"], *content["unsupervised"]["arms"]]
    third = {published.DENOISER_NAMES.get(name) for name in [*arms, *content["table3"]["classical"]]}
    assert set(published.TABLE_3) <= third | {"Noisy"}


def test_a_curve_says_whether_the_training_had_ended() -> None:
    assert still_falling(None) is None and still_falling([1.0]) is None
    assert still_falling([4.0, 2.0]) == pytest.approx(50.0)
