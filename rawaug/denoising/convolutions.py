r"""How fast convolutions are on this processor, in float32 and in bfloat16: measured once, and kept.

A processor's flags do not tell which precision is faster. With AVX-512 BF16 and without AMX, bfloat16 is 1.4 to 1.7
times as fast on AMD's and slower than float32 on some of Intel's. Two convolutions of 32 channels with a ReLU between
them, as the shipped networks have, take some milliseconds and answer it. The figures are kept in the user's cache
folder (``$XDG_CACHE_HOME/rawaug`` or ``~/.cache/rawaug``) with the name of the processor and all else that they depend
on; where it cannot be written, each process measures anew.
"""

from __future__ import annotations

import json
import os
import platform
import time
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from denoisers.layers import fused_conv
from rawaug.files import write_json

MARGIN = 1.05
"""bfloat16 is chosen where it is faster by this factor, since it costs 0.01 to 0.03 dB."""

SIZE_OF_NETWORKS = {"rawaug-small": 12.5, "rawaug-base": 122.6, "rawaug-best": 299.0}
"""Multiplications and additions of the shipped networks in GMAC a megapixel, as ``rawaug benchmark`` counts them."""

BESIDE = 1.3
"""A network takes this many times the time of its convolutions: tiles overlap, and there are other operations."""

USUAL = 12.0
"""A usual frame has this many megapixels."""

LONGEST = 60.0
"""A network that nobody named may take this many seconds for a usual frame."""

_CHANNELS, _SIDE, _REPEATS = 32, 128, 5


def processor_name() -> str:
    """Get the name of the processor as the system tells it."""
    table = Path("/proc/cpuinfo")
    if table.exists():
        for line in table.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":")[1].strip()
    return platform.processor() or platform.machine()


def convolution_speeds() -> dict[str, float]:
    """Get the speed of convolutions on this processor with PyTorch's present number of threads.

    Returns:
        GMAC a second in ``float32``, and in ``bfloat16`` where PyTorch can compute in it.
    """
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "all")
    threads = torch.get_num_threads()
    return _read_or_measure(f"{processor_name()}, {threads} threads, PyTorch {torch.__version__}, instructions {limit}")


@cache
def _read_or_measure(machine: str) -> dict[str, float]:
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rawaug"
    path = folder / "convolutions.json"
    kept: dict[str, dict[str, float]] = {}
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        return {precision: float(speed) for precision, speed in kept[machine].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # there is none yet, or somebody else's
        speeds = measure_convolutions()

    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json({**kept, machine: speeds} if isinstance(kept, dict) else {machine: speeds}, path)
    except OSError:
        pass
    return speeds


@torch.inference_mode()
def measure_convolutions() -> dict[str, float]:
    """Measure what :func:`convolution_speeds` returns: the fastest of five runs of each precision, in turn."""
    layers = [nn.Conv2d(_CHANNELS, _CHANNELS, 3, padding=1, bias=False) for _ in range(2)]
    network = nn.Sequential(layers[0], nn.ReLU(), layers[1]).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    image = torch.ones(1, _CHANNELS, _SIDE, _SIDE).to(memory_format=torch.channels_last)
    halved = image.to(torch.bfloat16)

    def run_in_bfloat16() -> Tensor:
        return fused_conv(fused_conv(halved, layers[0]), layers[1], added=halved)

    runs = {"float32": lambda: network(image), "bfloat16": run_in_bfloat16}
    seconds = dict.fromkeys(runs, float("inf"))
    for _ in range(1 + _REPEATS):  # the first run prepares the weights, and is never the fastest
        for precision in list(seconds):
            start = time.process_time()  # which other programs do not lengthen
            try:
                runs[precision]()
            except RuntimeError:  # oneDNN has no bfloat16 for this processor
                del seconds[precision]
                continue
            taken = (time.process_time() - start) / torch.get_num_threads()
            seconds[precision] = min(seconds[precision], taken)

    gmac = len(layers) * 9 * _CHANNELS**2 * _SIDE**2 / 1e9
    return {precision: round(gmac / taken, 1) for precision, taken in seconds.items()}


def has_fast_bfloat16(device: torch.device) -> bool:
    """Tell whether dense convolutions are faster in bfloat16 there: as measured on a CPU, or on newer GPUs."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    if device.type != "cpu":
        return False

    speeds = convolution_speeds()
    return speeds.get("bfloat16", 0.0) > MARGIN * speeds["float32"]


def expect_seconds(network: str, megapixels: float) -> float:
    """Estimate how long a network of :data:`SIZE_OF_NETWORKS` takes for a frame on this processor."""
    speed = max(convolution_speeds().values())
    return BESIDE * SIZE_OF_NETWORKS[network] * megapixels / speed


def choose_network(device: torch.device) -> str:
    """Choose the network of RAW files that are denoised without the name of one.

    It is ``rawaug-base``, or ``rawaug-small`` where base would take longer than :data:`LONGEST` for a usual frame.
    """
    if device.type == "cpu" and expect_seconds("rawaug-base", USUAL) > LONGEST:
        return "rawaug-small"
    return "rawaug-base"
