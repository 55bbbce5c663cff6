"""The faster precision of a processor is measured, not read from its flags, and kept."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

import denoisers
from rawaug.denoising import convolutions

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    convolutions._read_or_measure.cache_clear()
    return tmp_path / "rawaug" / "convolutions.json"


def test_the_measurement_is_made_once_and_kept_by_processor(
    cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    speeds = convolutions.convolution_speeds()
    assert speeds["float32"] > 0
    (machine,) = json.loads(cache_folder.read_text())
    assert convolutions.processor_name() in machine and torch.__version__ in machine

    monkeypatch.setattr(convolutions, "measure_convolutions", lambda: pytest.fail("measured twice"))
    convolutions._read_or_measure.cache_clear()
    assert convolutions.convolution_speeds() == speeds


@pytest.mark.parametrize("content", ["", "[]", '{"a": 1}'])
def test_a_file_of_somebody_else_is_replaced(cache_folder: Path, content: str) -> None:
    cache_folder.parent.mkdir()
    cache_folder.write_text(content)
    speeds = convolutions.convolution_speeds()
    assert speeds in json.loads(cache_folder.read_text()).values()


@pytest.mark.parametrize(
    ("speeds", "fast"),
    [
        ({"float32": 40.0, "bfloat16": 80.0}, True),
        ({"float32": 40.0, "bfloat16": 38.0}, False),
        ({"float32": 9.0}, False),
    ],
)
def test_bfloat16_is_fast_where_it_was_measured_to_be(
    speeds: dict[str, float], fast: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convolutions, "measure_convolutions", lambda: speeds)
    assert convolutions.has_fast_bfloat16(CPU) is fast


def test_a_slow_processor_gets_the_small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    for speed, network in ((20.0, "rawaug-small"), (200.0, "rawaug-base")):
        monkeypatch.setattr(convolutions, "measure_convolutions", lambda speed=speed: {"float32": speed})
        convolutions._read_or_measure.cache_clear()
        assert convolutions.choose_network(CPU) == network
        for kept in Path(os.environ["XDG_CACHE_HOME"]).rglob("*.json"):
            kept.unlink()


@pytest.mark.parametrize("name", ["rawaug-small", "rawaug-base"])
def test_the_sizes_of_networks_are_those_that_are_counted(name: str) -> None:
    network, image = denoisers.from_pretrained(name), torch.rand(1, 4, 128, 128)
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        network(image, torch.full_like(image, 1e-3))
    gmac = counter.get_total_flops() / 2e9 / (image.numel() / 1e6)
    assert convolutions.SIZE_OF_NETWORKS[name] == pytest.approx(gmac, rel=0.1)


def test_a_processor_whose_flags_promise_more_than_it_has_computes_in_float32() -> None:
    code = (
        "import torch; from rawaug.denoising.convolutions import has_fast_bfloat16 as f; print(f(torch.device('cpu')))"
    )
    lesser = os.environ | {"ONEDNN_MAX_CPU_ISA": "AVX2"}
    done = subprocess.run([sys.executable, "-c", code], env=lesser, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
