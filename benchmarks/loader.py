"""What rawaug costs a training: a whole DataLoader, and a training step, with it and without, as ratios.

    python -m benchmarks.loader [PICTURES] [--json FILE] [--workers N] [--device cpu|cuda] [--quick]

The loader reads a folder of pictures, crops and collates; RawPairs makes the pairs in its workers, wrap on the device.
The step is that of denoisers.UNet on a batch of pairs, alone and with the batch made by RawAugment first.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import rawaug
from benchmarks.measure import arguments, fastest, finish, start, write_pictures
from denoisers import UNet
from rawaug.bayer import RandomCrop
from rawaug.data import PictureFolder
from rawaug.seeding import keyed_generator


class Crops(Dataset[Tensor]):
    """What a loader does without rawaug: read, crop."""

    def __init__(self, pictures: PictureFolder, crop: int) -> None:
        self.pictures, self.crop = pictures, RandomCrop(crop)

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> Tensor:
        part: Tensor = self.crop(self.pictures[index], keyed_generator("crops", index)).clone()
        return part


def time_loaders(folder: Path, args: argparse.Namespace) -> dict[str, float]:
    """Seconds of an epoch, workers kept."""
    pictures, augment = PictureFolder(folder), rawaug.RawAugment.from_pretrained("universal")
    settings: dict[str, Any] = {"batch_size": args.batch, "num_workers": args.workers}
    settings["persistent_workers"] = args.workers > 0
    crops = DataLoader(Crops(pictures, args.crop), **settings)
    pairs = DataLoader(rawaug.RawPairs(pictures, augment, crop=args.crop), **settings)
    on_device = rawaug.RawAugment.from_pretrained("universal")
    wrapped = rawaug.wrap(DataLoader(Crops(pictures, args.crop), **settings), on_device, device=args.device)
    runs = {
        "without": lambda: [batch.to(args.device) for batch in crops],
        "RawPairs": lambda: [pair.noisy.to(args.device) for pair in pairs],
        "wrap": lambda: [pair.noisy for pair in wrapped],
    }
    return fastest(runs, args.repeats, args.device)


def time_steps(args: argparse.Namespace) -> dict[str, float]:
    """Seconds of a training step on a batch."""
    augment = rawaug.RawAugment.from_pretrained("universal").to(args.device)
    shape = (args.batch, 3, args.crop, args.crop)
    srgb = torch.randint(256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8).to(args.device)
    network = UNet(width=args.width).to(args.device)
    optimizer = torch.optim.Adam(network.parameters())

    def step(pair: rawaug.RawPair) -> None:
        optimizer.zero_grad()
        torch.nn.functional.l1_loss(network(pair.noisy, pair.variance), pair.clean).backward()
        optimizer.step()

    ready = augment(srgb)
    runs = {"without": lambda: step(ready), "RawAugment": lambda: step(augment(srgb))}
    return fastest(runs, args.repeats, args.device)


def main() -> None:
    parser = arguments(__doc__, repeats=5, quick="one repeat, batches of 4")
    parser.add_argument("pictures", type=Path, nargs="?", help="folder of pictures; by default the built-in ones")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--crop", type=int, default=128)
    parser.add_argument("--width", type=int, default=32, help="of the U-Net")
    args = parser.parse_args()
    args.repeats, args.batch = (1, 4) if args.quick else (args.repeats, args.batch)
    figures = start(args) | {"settings": {key: getattr(args, key) for key in ("workers", "batch", "crop", "width")}}
    with tempfile.TemporaryDirectory() as written:
        folder = args.pictures or write_pictures(Path(written))
        timed = {"loader": time_loaders(folder, args), f"step of UNet({args.width})": time_steps(args)}
    for what, seconds in timed.items():
        ratios = {name: value / seconds["without"] for name, value in seconds.items() if name != "without"}
        shown = "  ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
        print(f"  {what:20s} without {1e3 * seconds['without']:.0f} ms;  ratios: {shown}")
        figures[what] = {"seconds": seconds, "ratios": ratios}
    finish(figures, args)


if __name__ == "__main__":
    main()
