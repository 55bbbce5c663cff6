"""The kernels for a GPU: step by step on the CPU, compiled for a real target, and what is done where they fail."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug import kernels

triton = pytest.importorskip("triton", reason="pip install rawaug[test] on Linux")


@pytest.mark.long
def test_step_by_step_they_do_what_the_cpu_does() -> None:
    script = Path(__file__).with_name("kernels_interpreted.py")
    paths = os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == [
        *6 * ["raw"], *2 * ["blurred"], *2 * ["noise"], *2 * ["developed"], "finishing", "used",
    ]  # fmt: skip


@pytest.mark.parametrize("with_map", [True, False])
def test_the_noise_compiles_for_a_gpu(with_map: bool) -> None:
    from rawaug.kernels import gpu

    names = ("clean", "levels", "keys", "noisy", "variance", "cells", "white")
    types = dict(zip(names, ("*fp32", "*fp32", "*i64", "*fp32", "*fp32", "i32", "fp32"), strict=True))
    assert "st.global" in compiled_for_a_gpu(gpu._noise_cells, types, {"MAP": with_map, "BLOCK": 512})


@pytest.mark.parametrize(
    ("pixels", "all_stages", "blurs"),
    [("*u8", True, False), ("*fp32", False, False), ("*fp32", True, True), ("*u8", False, True)],
)
def test_the_raw_compiles_for_a_gpu(pixels: str, all_stages: bool, blurs: bool) -> None:
    from rawaug.kernels import gpu

    types = {
        "srgb": pixels,
        **dict.fromkeys(("table", "curves", "attention", "colour", "frame", "shading", "taps", "levels"), "*fp32"),
        "keys": "*i64",
        **dict.fromkeys(("raw", "noisy", "variance"), "*fp32"),
    }
    types |= {"h": "i32", "w": "i32", **dict.fromkeys(("scale", "knee", "white"), "fp32")}
    constants = {"S0": 0, "S1": 6, "S2": 5, "S3": 11, "NODES": 65, "ENTRIES": 0 if all_stages else 256, "BLOCK": 256}
    constants |= {"ATTENDS": all_stages, "SHADES": all_stages, "BLURS": blurs, "LINEAR": blurs and all_stages}
    constants |= {"COLOURS": all_stages, "NOISE": True, "MAP": blurs}
    assert "st.global" in compiled_for_a_gpu(gpu._raw_cells, types, constants)


def test_developing_compiles_for_a_gpu() -> None:
    from rawaug.kernels import gpu_srgb

    sides = {"h": "i32", "w": "i32"}
    mosaic = {"raw": "*fp32", "methods": "*i64", "gains": "*fp32", "pictures": "*fp32", **sides}
    mosaic |= {"red_row": "i32", "red_column": "i32"}
    leads = {"methods": "*i64", "pictures": "*fp32", "leads": "*i8", **sides}
    for kernel, types in ((gpu_srgb._greens, mosaic), (gpu_srgb._colours, mosaic), (gpu_srgb._leads, leads)):
        assert "st.global" in compiled_for_a_gpu(kernel, types, {"BLOCK": 256})

    settings = ("weights", "table", "curves", "attention", "matrix", "gains", "frame", "shading", "srgb")
    types = {"raw": "*fp32", **leads, **dict.fromkeys(settings, "*fp32")}
    types = {name: types[name] for name in ("raw", "methods", "pictures", "leads", *settings, "h", "w")}
    for entries in (0, 1025):
        constants = {"NODES": 65, "ENTRIES": entries, "ATTENDS": not entries, "SHADES": not entries, "BLOCK": 256}
        assert "st.global" in compiled_for_a_gpu(gpu_srgb._srgb_pixels, types, constants)


def test_finishing_compiles_for_a_gpu() -> None:
    from rawaug.kernels import gpu_srgb

    types = {**dict.fromkeys(("source", "taps", "out"), "*fp32"), **dict.fromkeys(("count", "h", "w", "reach"), "i32")}
    assert "st.global" in compiled_for_a_gpu(gpu_srgb._smooth_lines, types, {"DOWN": True, "BLOCK": 256})
    types = {"pairs": "*fp32", "means": "*fp32", "size": "i32"}
    assert "st.global" in compiled_for_a_gpu(gpu_srgb._mean_squares, types, {"BLOCK": 2048})


def compiled_for_a_gpu(kernel: Any, types: dict[str, str], constants: dict[str, Any]) -> str:
    """PTX for compute capability 8.0; needs no GPU."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    source = ASTSource(kernel, {**types, **dict.fromkeys(constants, "constexpr")}, constants)
    return str(triton.compile(source, target=GPUTarget("cuda", 80, 32), options={"enable_fp_fusion": True}).asm["ptx"])


def test_a_kernel_that_fails_is_reported_once_and_pytorch_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_failed", [])

    def fails() -> int:
        raise RuntimeError("no ptxas\nfor this target")

    with pytest.warns(UserWarning, match="RuntimeError"):
        assert kernels.try_kernel(fails, lambda: 2) == 2
    assert not kernels.can_use_triton(torch.zeros(1, device="meta"))

    def has_no_room() -> int:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(torch.OutOfMemoryError):
        kernels.try_kernel(has_no_room, lambda: 2)
    assert kernels._failed == ["RuntimeError"]
