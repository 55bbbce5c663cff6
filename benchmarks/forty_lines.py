"""RawPairs against one's own forty lines: UPI and Gaussian noise in a Dataset, with Pillow or OpenCV.

    python -m benchmarks.forty_lines [PICTURES] [--json FILE] [--crops 128 256] [--batches 1 16] [--workers 0] [--quick]

CPU milliseconds of a sample, from the JPEG to the collated pair, in one thread and interleaved; with workers, those of
the workers. OpenCV is measured where it is installed (``pip install opencv-python-headless``).
"""

from __future__ import annotations

import argparse
import io
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import rawaug
from benchmarks.measure import arguments, finish, start
from rawaug.data import demo_pictures

XYZ_TO_CAMERA = [
    [[1.0234, -0.2969, -0.2266], [-0.5625, 1.6328, -0.0469], [-0.0703, 0.2188, 0.6406]],
    [[0.4913, -0.0541, -0.0202], [-0.613, 1.3513, 0.2906], [-0.1564, 0.2151, 0.7183]],
    [[0.838, -0.263, -0.0639], [-0.2887, 1.0725, 0.2496], [-0.0627, 0.1427, 0.5438]],
    [[0.6596, -0.2079, -0.0562], [-0.4782, 1.3016, 0.1933], [-0.097, 0.1581, 0.5181]],
]
"""Those of Brooks et al., CVPR 2019 (their published code)."""
RGB_TO_XYZ = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]


class Unprocessed(Dataset[tuple[Tensor, Tensor]]):
    """One's own forty lines: read, crop, turn, unprocess, mosaic, add noise."""

    def __init__(self, files: list[Path], crop: int, read: Callable[[Path], np.ndarray[Any, Any]]) -> None:
        self.files, self.crop, self.read = files, crop, read
        self.matrices = torch.tensor(XYZ_TO_CAMERA)
        self.rgb_to_xyz = torch.tensor(RGB_TO_XYZ)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        picture = self.read(self.files[index])
        top = 2 * int(torch.randint((picture.shape[0] - self.crop) // 2 + 1, ()))
        left = 2 * int(torch.randint((picture.shape[1] - self.crop) // 2 + 1, ()))
        patch = picture[top : top + self.crop, left : left + self.crop]
        if torch.rand(()) < 0.5:
            patch = patch[:, ::-1]
        if torch.rand(()) < 0.5:
            patch = patch[::-1]
        if torch.rand(()) < 0.5:
            patch = patch.transpose(1, 0, 2)
        image = torch.from_numpy(np.ascontiguousarray(patch)).float() / 255.0

        weights = torch.rand(4, 1, 1)
        matrix = (self.matrices * weights).sum(0) / weights.sum() @ self.rgb_to_xyz
        matrix = matrix / matrix.sum(-1, keepdim=True)
        gain = 1.0 / (0.8 + 0.1 * torch.randn(()))
        gains = torch.stack([1.0 / (1.9 + 0.5 * torch.rand(())), torch.ones(()), 1.0 / (1.5 + 0.4 * torch.rand(()))])

        image = 0.5 - torch.sin(torch.asin(1.0 - 2.0 * image) / 3.0)
        image = image.clamp(min=1e-8) ** 2.2
        image = image @ matrix.T
        grey = image.mean(-1, keepdim=True)
        mask = ((grey - 0.9).clamp(min=0.0) / 0.1) ** 2
        factors = gains / gain
        image = (image * torch.maximum(mask + (1.0 - mask) * factors, factors)).clamp(0.0, 1.0)

        planes = [image[::2, ::2, 0], image[::2, 1::2, 1], image[1::2, ::2, 1], image[1::2, 1::2, 2]]
        clean = torch.stack(planes)
        log_shot = np.log(1e-4) + (np.log(0.012) - np.log(1e-4)) * torch.rand(())
        log_read = 2.18 * log_shot + 1.2 + 0.26 * torch.randn(())
        variance = clean * log_shot.exp() + log_read.exp()
        return clean + torch.randn(clean.shape) * variance.sqrt(), clean


def read_with_pillow(file: Path) -> np.ndarray[Any, Any]:
    from PIL import Image

    with Image.open(file) as image:
        return np.asarray(image.convert("RGB"))


def read_with_opencv(file: Path) -> np.ndarray[Any, Any]:
    import cv2  # type: ignore[import-not-found, unused-ignore]

    return cv2.imread(str(file))[:, :, ::-1]


def decoders() -> dict[str, Callable[[Path], np.ndarray[Any, Any]]]:
    """One's own ways to read a picture."""
    readers: dict[str, Callable[[Path], np.ndarray[Any, Any]]] = {"Pillow": read_with_pillow}
    try:
        import cv2
    except ImportError:
        return readers
    cv2.setNumThreads(1)
    return readers | {"OpenCV": read_with_opencv}


def write_jpegs(folder: Path, count: int) -> list[Path]:
    """JPEGs of 0.2 to 0.45 megapixels, as photographs for the screen are: quality 90, 4:2:0."""
    from PIL import Image

    files = []
    pictures = demo_pictures(12)
    for number in range(count):
        height, width = [(400, 500), (480, 640), (576, 768), (512, 640)][number % 4]
        picture = pictures[number % len(pictures)]
        image = Image.fromarray(picture.permute(1, 2, 0).numpy()).resize((width, height), Image.Resampling.BICUBIC)
        stored = io.BytesIO()
        image.save(stored, "JPEG", quality=90)
        files.append(folder / f"{number:03d}.jpg")
        files[-1].write_bytes(stored.getvalue())
    return files


def cpu_seconds(workers: int) -> float:
    """CPU time of this process, or of its workers that have ended."""
    if workers:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime
    return time.process_time()


def time_samples(datasets: dict[str, Any], batch_size: int, workers: int, repeats: int) -> dict[str, list[float]]:
    """CPU milliseconds of a sample in each repeat; the datasets take turns."""
    times: dict[str, list[float]] = {name: [] for name in datasets}
    for repeat in range(repeats + 1):
        for name, dataset in datasets.items():
            loader = DataLoader(dataset, batch_size, shuffle=True, num_workers=workers, drop_last=True)
            before = cpu_seconds(workers)
            samples = sum(len(batch[0]) for batch in loader)
            del loader
            if repeat:  # the first one warms up
                times[name].append(1e3 * (cpu_seconds(workers) - before) / samples)
    return times


def main() -> None:
    parser = arguments(__doc__, repeats=7, quick="one repeat of few pictures")
    parser.add_argument("pictures", type=Path, nargs="?", help="folder of JPEGs; by default drawn ones")
    parser.add_argument("--crops", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--workers", type=int, nargs="+", default=[0])
    parser.add_argument("--count", type=int, default=64, help="number of drawn pictures")
    args = parser.parse_args()
    args.repeats, args.count = (1, 16) if args.quick else (args.repeats, args.count)
    figures = start(args)
    torch.set_num_threads(1)

    with tempfile.TemporaryDirectory() as written:
        folder = args.pictures or Path(written)
        files = sorted(args.pictures.glob("*.jp*g")) if args.pictures else write_jpegs(folder, args.count)
        for crop in args.crops:
            datasets: dict[str, Any] = {name: Unprocessed(files, crop, read) for name, read in decoders().items()}
            fields = ("noisy", "clean")
            datasets["RawPairs"] = rawaug.RawPairs(folder, "universal", crop=crop, fields=fields)
            for batch_size in args.batches:
                for workers in args.workers:
                    show(figures, datasets, crop, batch_size, workers, args)
    finish(figures, args)


def show(
    figures: dict[str, Any],
    datasets: dict[str, Any],
    crop: int,
    batch_size: int,
    workers: int,
    args: argparse.Namespace,
) -> None:
    """Print a row: milliseconds, and how many times as fast RawPairs are as each of the others."""
    times = time_samples(datasets, batch_size, workers, args.repeats)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    cells = []
    for name, median in medians.items():
        ratios = np.array(times[name]) / np.array(times["RawPairs"])
        cells.append(f"{name} {median:5.2f} ms" + (f" ({np.median(ratios):.2f})" if name != "RawPairs" else ""))
    print(f"  crop {crop:4d}, batch {batch_size:3d}, workers {workers}: " + "  ".join(cells), flush=True)
    figures[f"crop {crop}, batch {batch_size}, workers {workers}"] = times


if __name__ == "__main__":
    main()
