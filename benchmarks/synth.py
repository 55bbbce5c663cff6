"""What pairs cost: processor seconds of ``rawaug synth`` in each format, and of pairs made online, against decoding.

    python -m benchmarks.synth [PICTURES] [--count 64] [--size 375 500] [--formats npz dng webdataset] [--json FILE]

Every way goes over the same pictures in this process alone; processor seconds, so that other work on the machine counts
less. *online* makes a pair of one crop of each picture, a format the pair of the whole picture.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rawaug
from benchmarks.measure import arguments, finish, show, start, write_pictures
from rawaug.data import PictureFolder
from rawaug.io import read_picture
from rawaug.synthesis.folder import synth

ONLINE_CROP = 256


def costs(folder: Path, formats: Sequence[str], repeats: int) -> dict[str, dict[str, float]]:
    """Mpix a processor second of each way, and its time over that of decoding."""
    pictures = PictureFolder(folder)
    megapixels = sum(pictures[k][0].numel() for k in range(len(pictures))) / 1e6
    crop = min(ONLINE_CROP, *(side // 2 * 2 for side in pictures[0].shape[1:]))
    pairs = rawaug.RawPairs(pictures, "universal", crop=crop)
    pairs[0]  # compiles

    def written(form: str) -> Callable[[], object]:
        def run() -> object:
            with tempfile.TemporaryDirectory() as out:
                return synth(folder, out, form, workers=0)  # type: ignore[arg-type]

        return run

    ways: dict[str, Callable[[], object]] = {
        "decode": lambda: [read_picture(pictures.file(k)).shape for k in range(len(pictures))],
        "online": lambda: [pairs[k].noisy.shape for k in range(len(pictures))],
        **{form: written(form) for form in formats},
    }
    best = dict.fromkeys(ways, float("inf"))
    for name in [*ways] * repeats:
        begin = time.process_time()
        ways[name]()
        best[name] = min(best[name], time.process_time() - begin)
    return {
        name: {"Mpix a processor second": megapixels / taken, "times decoding": taken / best["decode"]}
        for name, taken in best.items()
    }


def main() -> None:
    parser = arguments(__doc__, repeats=3, quick="one repeat of eight pictures")
    parser.add_argument("pictures", type=Path, nargs="?", help="folder of pictures; by default built-in ones")
    parser.add_argument("--count", type=int, default=64, help="of the built-in ones")
    parser.add_argument("--size", type=int, nargs=2, help="their height and width")
    parser.add_argument("--formats", nargs="+", default=["npz", "dng", "webdataset"])
    parser.set_defaults(threads=1)
    args = parser.parse_args()
    args.count, args.repeats = (8, 1) if args.quick else (args.count, args.repeats)
    os.environ["RAWAUG_READ_SECONDS"] = "0"  # decode in this process
    figures = start(args)
    with tempfile.TemporaryDirectory() as written:
        folder = args.pictures or write_pictures(Path(written), args.count, args.size)
        figures["costs"] = costs(folder, args.formats, args.repeats)
    show(figures["costs"])
    finish(figures, args)


if __name__ == "__main__":
    main()
