"""The benchmarks, run tiny on the CPU: what they print means what they say, and the files they make are right."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import (
    augment,
    binning,
    crops,
    denoise,
    figures,
    gpu,
    grain,
    ingredients,
    judging,
    measure,
    patterns,
    pictures,
    sensors,
    synth,
)
from denoisers.files import find_denoiser
from denoisers.network import DENOISERS
from rawaug.data.demo import FRAME
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import NOISY
from rawaug.files import sha256
from rawaug.io import read_picture

CPU = torch.device("cpu")


def test_augmentation_is_compared_in_one_unit() -> None:
    rows = augment.measure(augment.pictures(2, 32, 48), repeats=1, gb_s=10.0)
    assert {"rawaug", "rawaug, drawn before", "upi", "srgb", "copy"} <= set(rows)
    ours = rows["rawaug"]
    assert ours["counted"] == pytest.approx(ours["mpix_s"] * 1e6 * 11 / 10e9)
    assert ours["moved"] == pytest.approx(ours["counted"] * 19 / 11)
    assert rows["upi"]["ratio"] == pytest.approx(ours["mpix_s"] / rows["upi"]["mpix_s"])
    assert "moved" not in rows["upi"], "what other methods move is not known"


def test_the_benchmark_of_gpus_runs_every_part_and_judges_its_bars(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    figures = gpu.main(["--device", "cpu", "--quick", "--threads", "1", "--json", str(out)])
    assert json.loads(out.read_text()).keys() == figures.keys()
    assert {"crops", "whole frames", "steps", "training", "loaders", "rawaug-small", "rawaug-base"} <= set(figures)
    assert len(figures["bars"]) == len(gpu.BARS), "every bar finds its figure"
    part, row, figure, limit, _ = gpu.BARS[0]
    assert gpu.judge({part: {row: {figure: limit / 2}}}) == {f"{part}, {row}: {figure} at most {limit:g}": True}
    assert not any(gpu.judge({part: {row: {figure: 2 * limit}}}).values())


def test_denoising_is_timed_whole_and_in_tiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    denoise.main(["--megapixels", "0.01", "--repeats", "1", "--json", str(out)])
    rows = json.loads(out.read_text())["0.01 Mpix"]
    forms = {f"{form}, {p}" for form in ("whole", "tiles") for p in ("float32", "bfloat16")}
    assert set(rows) == forms | {"rawaug denoise"}
    assert all(row["seconds"] > 0 for row in rows.values())
    assert denoise.frame(12, CPU).shape == (1, 4, 1414, 2121)
    capsys.readouterr()


def test_pairs_on_disk_and_online_are_compared_with_decoding(tmp_path: Path) -> None:
    rows = synth.costs(measure.write_pictures(tmp_path, 2, (32, 48)), ["npz"], repeats=1)
    assert list(rows) == ["decode", "online", "npz"] and rows["decode"]["times decoding"] == 1.0
    assert all(row["Mpix a processor second"] > 0 for row in rows.values())
    assert read_picture(tmp_path / "000001.jpg").shape == (3, 32, 48)


def test_pieces_of_frames_are_drawn_beside_a_filter(tmp_path: Path) -> None:
    print_ = crops.page()
    assert print_.clean.mosaic.shape == (1, *FRAME) and print_.clean.mosaic.std() > 0.05, "there is print on the paper"
    crops.main(["demo:test", "--place", "page", "0", "0", "--iso", "6400", "--out", str(tmp_path / "crops.png")])
    assert read_picture(tmp_path / "crops.png").shape == (3, 325, 1092), "noisy, filtered, by the network, clean"
    with pytest.raises(SystemExit, match="page:"):
        crops.main(["demo:test", "--place", "page", "40", "0", "--out", str(tmp_path / "crops.png")])


def test_sensors_scores_flat_patches_frames_and_cells_beside_lights() -> None:
    clean = torch.full((1, 4, 40, 40), 0.25)
    clean[..., 10:20, 10:20] = 1.0
    as_it_is, black = NOISY, RawDenoiser.of(lambda noisy: torch.zeros_like(noisy))
    assert sensors.left_in_flat(as_it_is, (1e-3, 1e-5)) == 1.0
    expected = -10 * math.log10(1e-3 * 0.25 + 1e-5)
    assert sensors.mean_psnr(as_it_is, [("flat", torch.full((1, 4, 64, 64), 0.25))], (1e-3, 1e-5)) == pytest.approx(
        expected, abs=0.15
    )
    assert sensors.beside_lights(black, [("light", clean)], (1e-6, 1e-9)) == (0.0, 12.04)


def test_binning_scores_the_same_noise_on_both_kinds_of_reference(tmp_path: Path) -> None:
    binning.main(["rawaug-small", "--data", "real:train", "--bin", "2", "--quick", "--json", str(tmp_path / "f.json")])
    figures = json.loads((tmp_path / "f.json").read_text())
    squares, around = (figures[way] for way in binning.WAYS)
    assert squares["noisy"] == pytest.approx(around["noisy"], abs=0.1)
    assert around["rawaug-small"] > squares["rawaug-small"] + 0.1


@pytest.mark.parametrize("name", ingredients.ARMS)
def test_every_arm_begins_as_the_identity_and_all_of_its_layers_learn(name: str) -> None:
    arm = ingredients.ARMS[name]
    network = DENOISERS[arm.network](**arm.settings)
    noisy = torch.rand(1, 4, 48, 40, generator=torch.Generator().manual_seed(0))
    variance = 1e-3 * noisy + 1e-5
    if not arm.settings.get("mend"):
        torch.testing.assert_close(network(noisy, variance), noisy)

    torch.nn.init.normal_(network.tail.weight, 0.0, 0.1)
    for end in network.block_ends():
        torch.nn.init.normal_(end.weight, 0.0, 0.1)
    network(noisy, variance).square().mean().backward()
    assert all(weight.grad.abs().max() > 0 for weight in network.parameters())


def test_a_repeated_network_is_given_what_it_has_corrected() -> None:
    once = ingredients.RepeatedDRUNet(repeats=1, width=4, scales=2)
    twice = ingredients.RepeatedDRUNet(repeats=2, width=4, scales=2)
    torch.nn.init.normal_(once.tail.weight, 0.0, 0.1)
    twice.load_state_dict(once.state_dict())
    features = torch.rand(1, once.inputs - 4, 16, 16)

    first = once.residual(features)
    again = torch.cat([features[:, :4] + first, features[:, 4:], first], dim=1)
    second = first + once.tail(once.body(again))
    torch.testing.assert_close(twice.residual(features), second)


def test_ingredients_are_trained_once_for_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ingredients, "MIDDLE", 32)
    monkeypatch.setattr(ingredients, "PROBE", 1)
    table = tmp_path / "table.json"
    command = [str(table), "--minutes", "0", "--precision", "32-true", "--arms", "the same, blind", "--seeds"]
    ingredients.main([*command, "1"])
    first = json.loads(table.read_text())
    assert first["the same, blind"]["steps"] == ingredients.POINTS

    ingredients.main([*command, "2"])
    both = json.loads(table.read_text())["the same, blind"]["runs"]
    assert both["0"] == first["the same, blind"]["runs"]["0"], "what stands in the table is not trained again"
    assert [point["step"] for point in both["1"]["curve"]] == [1, 2, 3, 4, 5]
    assert both["1"]["curve"][-1]["psnr_phone"] != both["0"]["curve"][-1]["psnr_phone"]
    assert "±" in capsys.readouterr().out


def test_grain_of_one_per_cent_of_mid_grey_stays() -> None:
    strong = math.sqrt(7e-3 * 0.18 + 1.8e-4) / 0.18
    assert (1.0 - grain.share_removed(7e-3, 1.8e-4)) * strong == pytest.approx(0.01)
    assert grain.share_removed(1e-7, 1e-9) == 0.0, "weaker noise stays as it is"


def test_patterns_are_compared_in_full_colour(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    common = ["--data", "demo:test", "--bin", "1", "--quick", "--json", str(out)]
    patterns.main(["NonLocalMeans", *common, "--patterns", "GRBG", "XTRANS"])
    figures = json.loads(out.read_text())
    assert "NonLocalMeans" in figures["GRBG"] and "NonLocalMeans" not in figures["XTRANS"], "filters are for Bayer"
    for rows in (figures["GRBG"], figures["XTRANS"]):
        assert rows["NonLocalMeans of the picture, 1"][0] > rows["noisy"][0] + 2


def test_files_are_compared_with_other_readers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = measure.write_pictures(tmp_path / "in", 2, (32, 48))
    (tmp_path / "in" / "cut.jpg").write_bytes((source / "000000.jpg").read_bytes()[:300])
    (tmp_path / "in" / "notes.txt").write_text("words")
    assert pictures.main([str(tmp_path / "in"), "--json", str(tmp_path / "out.json")]) == 0
    rows = json.loads((tmp_path / "out.json").read_text())
    outcomes = {Path(row["path"]).name: row["outcome"] for row in rows}
    assert outcomes["000000.jpg"] == outcomes["000001.jpg"] == "equal"
    assert outcomes["notes.txt"] == "neither picture nor RAW" and "refused" in outcomes["cut.jpg"]
    assert "4 files" in capsys.readouterr().out


def test_a_figure_of_drawn_noise_is_bold_only_where_every_frame_says_so() -> None:
    ahead = [(40.0, 30.0), (50.0, 35.0), (45.0, 33.0), (42.0, 31.0)]
    behind = [(raw - 0.5 + 0.01 * k, srgb + (-1) ** k) for k, (raw, srgb) in enumerate(ahead)]
    rows = figures.figures_of_drawn_noise("strong", {"rawaug-base": ahead, "PBRID": behind})
    assert rows["strong"] == {"rawaug-base": "**44.25** / 32.25", "PBRID": "43.77 / 32.25"}
    low, high = map(float, rows["strong, its interval"]["rawaug-base"].split(" to "))
    assert 0.4 < low < 0.49 < high < 0.55

    alone = figures.figures_of_drawn_noise("strong", {"rawaug-base": ahead[:1], "PBRID": behind[:1]})
    assert alone["strong"]["rawaug-base"] == "40.00 / 30.00" and not alone["strong, its interval"]


def test_figures_of_strengths_and_the_picture_of_their_costs() -> None:
    table: dict[str, Any] = {"GMAC": {"rawaug-base": 123.4, "NonLocalMeans": None}}
    for frame, psnr in (("hero6_1", 40.0), ("hero7_1", 42.0), ("hero7_2", 44.0)):
        cells = {"noisy": [30.0, 20.0, None], "rawaug-base": [psnr, 30.0, 0.25], "NonLocalMeans": [38.0, 29.0, None]}
        cells["rawaug-base+guard"] = [psnr + 1.0, 30.0, None]
        table[f"/x/GOPRO@4 | levels told | strong | {frame}"] = cells
        table[f"/x/GOPRO@4 | levels estimated | strong | {frame}"] = {"noisy": [0.0, 0.0, None]}
    rows = figures.figures_of_strengths(table)
    assert rows["GMAC"] == {"rawaug-base": "123"} and rows["hero, strong"]["own noise"] == "25 %"
    assert rows["hero7, strong"]["rawaug-base, guarded"].startswith("44.00 / ")
    shown = [rows[f"{name}, strong"]["rawaug-base"] for name in ("hero", "hero6", "hero7")]
    assert [cell.replace("*", "").split(" / ")[0] for cell in shown] == ["42.00", "40.00", "43.00"]
    assert figures.plot_row(rows, "hero, strong").startswith(b"\x89PNG")


def test_an_order_is_contradicted_only_by_intervals_that_are_apart() -> None:
    """A cell is estimate, its interval, truth, and the interval of what it is behind the best by."""
    best, near = [41.0, 40.5, 41.5, 40.9, 0.0, 0.0], [40.9, 40.4, 41.4, 41.0, -0.1, 0.3]
    row = judging.summarise([{"best": best, "near": near}] * 2)
    assert row["exchanged"] == pytest.approx(0.1) and row["contradicted"] == 0.0 and row["held"] == 4

    far = [*near[:4], 0.05, 0.15]
    row = judging.summarise([{"best": best, "far": far}] * 2)
    assert row["exchanged"] == row["contradicted"] == pytest.approx(0.1)
    assert judging.summarise([{"best": best, "far": [*far[:3], 40.8, *far[4:]]}])["exchanged"] == 0.0


def test_figures_of_harm() -> None:
    harm: dict[str, Any] = {
        "rawaug-base, guarded": {"frames": {"hot pixels": {"psnr": 47.716}}, "kept": {"1.2": {"on R": 0.994}}}
    }
    harm["rawaug-base, guarded"]["fields"] = {"1.2": 60.871}
    rows = figures.figures_of_harm(harm)
    cells = [rows[row]["rawaug-base, guarded"] for row in ("hot pixels", "1.2, on R", "field 1.2")]
    assert cells == ["47.72", "99", "60.87"]


def test_figures_of_strong_pictures() -> None:
    ours, theirs = ([[26.0, 0.8], [28.0, 0.9]], [[25.0, 0.7], [26.8, 0.8]])
    scores = {"rawaug-srgb": ours, "/x/ffdnet_color.safetensors+refill@25": theirs}
    rows = figures.figures_of_strong_pictures({name: {"finished": s, "JPEG": s} for name, s in scores.items()})
    assert rows["JPEG"] == {"rawaug-srgb": "27.00 / 0.8500", "FFDNet, refilled, told 25": "25.90 / 0.7500"}
    assert rows["finished, blind ahead"]["FFDNet, refilled, told 25"].startswith("+1.10 (")
    assert "finished, told 40 ahead" not in rows


def test_figures_are_recorded_with_their_network(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    for psnr in ("1.00", "2.00"):
        row = {"strong": {"rawaug-small, guarded": psnr, "PBRID": "0.00"}}
        figures.record("set", row, "rawaug benchmark", "none", commit="abc", path=path)
    recorded = json.loads(path.read_text())["set"]
    assert recorded["figures"]["strong"]["rawaug-small, guarded"] == "2.00" and recorded["commit"] == "abc"
    assert recorded["networks"] == {"rawaug-small": sha256(find_denoiser("rawaug-small"))}


def test_figures_of_a_bracket() -> None:
    errors = {"noisy": [[4e-4, 4e-3], [4e-4, 4e-3], [8e-4, 4e-3]], "PBRID, published weights": [[1e-4, 1e-3]] * 3}
    shot = {
        "scores": {name: [38.0, 28.0] for name in errors},
        "first in": {"noisy": 0, "PBRID, published weights": 3},
        "gains": {"noisy": [-6.02, -9.0, -6.0]},
        "errors": errors,
    }
    rows = figures.figures_of_bracket({"machine": {}, "1/640 s against 1/160 s": shot})
    assert rows["1/640 s"] == {"noisy": "38.00 / 28.00", "PBRID": "38.00 / 28.00"}
    assert rows["1/640 s, best in"] == {"noisy": "0", "PBRID": "**3**"}
    assert rows["all blocks, PBRID ahead in"] == {"noisy": "3"}
    assert rows["all blocks, PBRID ahead by"] == {"noisy": "6.02"}
