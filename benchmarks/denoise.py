"""What denoising a frame costs: seconds and peak memory, whole and in tiles, in float32 and in bf16.

    python -m benchmarks.denoise [--device cpu|cuda] [--denoiser rawaug-small] [--megapixels 12 45] [--quick]

A frame is noise, packed, on the device; its time does not depend on what is in it. A form without figures is one that
the GPU's memory does not hold. The last row is ``rawaug denoise`` of such a frame, from a DNG to a DNG. Every form runs
``--repeats`` times after one that is not counted.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import denoisers
from benchmarks.damage import small_frame
from benchmarks.measure import arguments, fastest, finish, memory_used, show, start
from denoisers.files import DEFAULT
from rawaug import bayer
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.folder import denoise_file
from rawaug.denoising.raw import RawFiles
from rawaug.io import write_dng


def frame(megapixels: float, device: torch.device) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` of a mosaic with sides 2 : 3."""
    height = round((megapixels * 1e6 * 2 / 3) ** 0.5 / 2)
    return torch.rand(1, 4, height, round(1.5 * height), generator=torch.Generator().manual_seed(0)).to(device)


def measure(model: denoisers.Denoiser, noisy: Tensor, repeats: int) -> dict[str, dict[str, float]]:
    """Seconds, Mpix/s and peak MiB of each form; nothing for one that the GPU's memory does not hold."""
    variance, rows = 1e-3 * noisy + 1e-5, dict[str, dict[str, float]]()
    forms: dict[str, Callable[..., Tensor]] = {"whole": model, "tiles": partial(denoisers.denoise_tiles, model)}
    for form, run in forms.items():
        for precision in (torch.float32, torch.bfloat16):
            label = f"{form}, {str(precision).removeprefix('torch.')}"
            try:
                rows[label] = timed(run, noisy, variance, precision, repeats)
            except torch.OutOfMemoryError:
                rows[label] = {}
    return rows


@torch.inference_mode()
def timed(
    run: Callable[..., Tensor], noisy: Tensor, variance: Tensor, precision: torch.dtype, repeats: int
) -> dict[str, float]:
    """One form."""
    device = noisy.device
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == torch.bfloat16):
        run(noisy, variance)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        seconds = fastest({"one": lambda: run(noisy, variance)}, repeats, device)["one"]
    return {"seconds": seconds, "Mpix/s": noisy.numel() / seconds / 1e6, "peak MiB": memory_used(device) / 2**20}


def command(noisy: Tensor, denoiser: str, device: torch.device, repeats: int) -> dict[str, float]:
    """``rawaug denoise``, reading and writing included."""
    shot = small_frame(bayer.unpack(noisy[0].cpu(), "RGGB"), bayer.CFA.RGGB)
    method = RawDenoiser.of(denoiser, device, "auto")
    files = RawFiles(method, linear=method.demosaics)
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder, "noisy.dng"), Path(folder, "denoised.dng")
        write_dng(source, shot)
        runs = [denoise_file(source, out, files, overwrite=True)[1].seconds for _ in range(1 + repeats)]
    return {"seconds": min(runs[1:]), "Mpix/s": noisy.numel() / min(runs[1:]) / 1e6}


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, repeats=3, quick="one repeat of 0.25 Mpix")
    parser.add_argument("--denoiser", default=DEFAULT, help="name of a shipped denoiser, or its file")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[12.0, 45.0], help="of the mosaics")
    args = parser.parse_args(argv)
    if args.quick:
        args.megapixels, args.repeats = [0.25], 1
    model = denoisers.from_pretrained(args.denoiser)
    model = model.to(args.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    figures = start(args)
    for megapixels in args.megapixels:
        noisy, title = frame(megapixels, args.device), f"{megapixels:g} Mpix"
        figures[title] = measure(model, noisy, args.repeats)
        figures[title]["rawaug denoise"] = command(noisy, args.denoiser, args.device, args.repeats)
        print(title)
        show(figures[title])
    finish(figures, args)


if __name__ == "__main__":
    main()
