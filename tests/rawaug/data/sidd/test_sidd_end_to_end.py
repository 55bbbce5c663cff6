"""``sidd/full`` from end to end, in small: its files as published, made from the demo's frames; its commands."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.cli import main
from rawaug.data import SiddBenchmark, check_submission, demo_photographs
from rawaug.data.demo.camera import DemoCamera
from rawaug.data.pairs import Pair
from rawaug.data.sidd.frames import HELD_BACK, SiddScene
from rawaug.io import write_picture
from rawaug.io.raw import XYZ_FROM_SRGB

Writer = Callable[[Path, dict[str, Any]], Path]
SIDE = 16
"""Of a block; 256 as published."""
SCENES = ("0001_001_S6_00100_00060_3200_L", "0002_001_S6_00100_00020_3200_N", "0004_001_S6_00100_00060_4400_L")


def camera_frame(cfa: CFA, k: int) -> Pair:
    photograph = demo_photographs("train")["astronaut"][:, 64 : 64 + 96, 64 + 16 * k : 192 + 16 * k]
    return DemoCamera(cfa).capture(photograph, torch.Generator().manual_seed(k), iso=1600)


def write_medium(folder: Path, mat73: Writer) -> None:
    """Scene instances of SIDD Medium: RAW of version 7.3 without the noise's negative part, METADATA of version 5."""
    for k, name in enumerate(SCENES):
        pair = camera_frame(SiddScene.parse(name).cfa, k)
        at = folder / "Data" / name / f"{name[:4]}_"
        for kind, frame in (("GT", pair.raw), ("NOISY", pair.noisy)):
            assert frame is not None
            mat73(Path(f"{at}{kind}_RAW_010.MAT"), {"x": frame[0].clamp(0.0, 1.0).numpy()})
        tags = {"Orientation": 1, "AsShotNeutral": [1 / np.array(pair.white_balance)], "ColorMatrix2": dng_matrix(pair)}
        savemat(f"{at}METADATA_RAW_010.MAT", {"metadata": tags})


def dng_matrix(pair: Pair) -> np.ndarray:
    """XYZ to camera ``(1, 9)``, of which the pair's matrix is the inverse behind sRGB."""
    to_camera = np.diag(1 / np.array(pair.white_balance)) @ np.linalg.inv(pair.color_matrix.double().numpy())
    return (to_camera @ np.linalg.inv(XYZ_FROM_SRGB)).reshape(1, 9)


def write_blocks(folder: Path) -> None:
    """Validation and benchmark: 32 blocks of each of the forty scene instances, in the pattern of its phone."""
    folder.mkdir()
    frames = {cfa: camera_frame(cfa, 3) for cfa in CFA}
    found = [list(blocks_of(frames[SiddScene.parse(name).cfa])) for name in HELD_BACK]
    clean, noisy = (torch.stack([torch.stack([block[k] for block in scene]) for scene in found]) for k in (0, 1))
    for name, values in (("ValidationGt", clean), ("ValidationNoisy", noisy), ("BenchmarkNoisy", noisy.flip(1))):
        savemat(folder / f"{name}BlocksRaw.mat", {f"{name}BlocksRaw": values.numpy()}, do_compression=True)
    header = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
    pair = frames[CFA.GRBG]
    levels = ", ".join([f"{pair.shot_var}, {pair.read_var}"] * 3)
    rows = [header, *(f"{name}, {levels}" for name in HELD_BACK)]
    (folder / "noise_level_functions.csv").write_text("\n".join(rows))


def blocks_of(pair: Pair) -> Iterator[tuple[Tensor, Tensor]]:
    assert pair.noisy is not None
    for k in range(32):
        top, left = SIDE * (k // 8), SIDE * (k % 8)
        window = (0, slice(top, top + SIDE), slice(left, left + SIDE))
        yield pair.raw[window].clamp(0.0, 1.0), pair.noisy[window].clamp(0.0, 1.0)


@pytest.fixture(scope="module")
def sidd(tmp_path_factory: pytest.TempPathFactory, mat73: Writer) -> Path:
    folder = tmp_path_factory.mktemp("sidd")
    write_medium(folder / "SIDD_Medium_Raw", mat73)
    write_blocks(folder / "SIDD_Validation")
    (folder / "mirflickr").mkdir()
    for name, picture in demo_photographs("validation").items():
        write_picture(folder / "mirflickr" / f"{name}.png", picture[:, :64, :64])
    return folder


SMALL = [
    *("--train.steps", "2", "--train.batch", "2", "--train.crop", "32", "--train.workers", "0", "--train.warmup", "1"),
    *("--train.validate-every", "2", "--train.checkpoint-every", "2", "--train.precision", "32-true"),
    *("--isp.steps", "2", "--isp.curve-steps", "5", "--isp.pixels", "512", "--isp.batch", "128", "--device", "cpu"),
    *("--denoiser", '{"name": "UNet", "settings": {"width": 4, "scales": 2, "variance_map": false}}'),
    *("--data.test-count", "4", "--classical", "[]", "--self-ensemble", "false"),
    *("--arms", '{"dhdn": {"augmented": 0.0}, "ours": {"augmented": 0.75, "sampling": "convex"}}', "--untouched", "[]"),
]
"""Of the recipe's network, steps and five arms; 1,280 blocks, so that the benchmark takes the file: 5 s of CPU."""


@pytest.mark.long
def test_sidd_full_trains_scores_and_writes_what_the_benchmark_takes(
    sidd: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = ["--data.pairs", f"sidd:{sidd / 'SIDD_Medium_Raw'}", "--data.pictures", str(sidd / "mirflickr")]
    places += ["--data.test", f"sidd:{sidd / 'SIDD_Validation'}", "--out", str(tmp_path)]
    assert main(["run", "sidd/full", *places, *SMALL]) == 0
    run = tmp_path / "sidd" / "full"
    results = json.loads((run / "results.json").read_text())["results"]
    assert set(results) == {"dhdn", "ours"}
    for (scores,) in results.values():
        assert len(scores["plain"]["images"]) == 4 and 15.0 < scores["plain"]["psnr"] < 60.0
        assert "levels_from_clean" not in scores["plain"], "the levels are those of the table"
    weights = run / "seed0" / "ours" / "denoiser.safetensors"
    capsys.readouterr()
    out = tmp_path / "SubmitRaw.csv"
    assert main(["submit", f"sidd:{sidd / 'SIDD_Validation'}", str(out), "--denoiser", str(weights)]) == 0
    assert "1280 blocks, checked" in capsys.readouterr().out
    noisy = torch.stack([block.mosaic for block in SiddBenchmark(sidd / "SIDD_Validation")])
    shift = (check_submission(out, SIDE) - noisy).abs().mean((1, 2, 3))
    assert (shift > 0.0).all() and shift.max() < 0.2, "each block is a denoised one of its own"
