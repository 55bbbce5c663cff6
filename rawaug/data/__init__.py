"""The data that can be read: pictures, RAW files, published datasets and the built-in demo data.

They come as datasets of sRGB pictures (:func:`open_pictures`) or as RAW-sRGB pairs (:func:`open_pairs`). Data without a
clean version, the benchmarks of SIDD and DND, come as noisy blocks with a writer for submissions.
"""

from __future__ import annotations

from rawaug.data.check import check
from rawaug.data.demo import DemoCamera, demo_pairs, demo_photographs, demo_pictures
from rawaug.data.dnd import Dnd, write_dnd_submission
from rawaug.data.drawn import Shapes, dead_leaves
from rawaug.data.folders import PictureFolder, RawFolder
from rawaug.data.frames import Frames, as_frames
from rawaug.data.opening import open_pairs, open_pictures
from rawaug.data.pair_folder import PairFolder
from rawaug.data.pairs import DATASETS, PICTURES, Pair
from rawaug.data.points import Lights
from rawaug.data.sidd_benchmark import SiddBenchmark, write_submission

__all__ = [
    "DATASETS", "PICTURES", "DemoCamera", "Dnd", "Frames", "Lights", "Pair", "PairFolder", "PictureFolder", "RawFolder",
    "Shapes", "SiddBenchmark", "as_frames", "check", "dead_leaves", "demo_pairs", "demo_photographs", "demo_pictures",
    "open_pairs", "open_pictures", "write_dnd_submission", "write_submission",
]  # fmt: skip
