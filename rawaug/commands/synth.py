"""``rawaug synth``: RAW pairs on disk from a folder of sRGB pictures; in Python :func:`rawaug.synth`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from rawaug.commands import OPTIONS, parse_value
from rawaug.errors import escape
from rawaug.evaluation.tables import print_rows
from rawaug.io.pictures import MAX_PIXELS
from rawaug.plugin.config import AugmentConfig
from rawaug.plugin.draw import Draw
from rawaug.synthesis.files import Format
from rawaug.synthesis.folder import Synthesis, synth
from rawaug.synthesis.shards import PER_SHARD


@dataclass(frozen=True)
class SynthOptions(AugmentConfig):
    """The settings of an augmentation, each an option of its own."""

    draw: Annotated[Draw, OPTIONS] = Draw()


def run(
    pictures: str,
    out: str,
    /,
    *,
    format: Format = "dng",
    per_image: int = 1,
    config: Annotated[SynthOptions, OPTIONS] = SynthOptions(),
    seed: int = 0,
    workers: int | None = None,
    max_pixels: int = MAX_PIXELS,
    shard: str = "1/1",
    per_shard: int = PER_SHARD,
) -> None:
    """Write noisy and clean RAW pairs made from sRGB pictures.

    Args:
        pictures: folder of sRGB pictures, or one picture.
        out: output folder.
        format: 16-bit DNG of RAW, float32 NPZ, TIFF (float32, sRGB 16 bits), 8-bit PNG of sRGB, or tar shards for
            WebDataset and Hugging Face.
        per_image: pairs per picture.
        config: camera, noise and target of the pairs.
        seed: random seed.
        workers: number of processes; by default one per core.
        max_pixels: larger pictures are refused before they are decoded.
        shard: K/N makes part K of N, K from 1 to N, for job arrays; all N write to the same folder.
        per_shard: pictures per tar file, with --format webdataset.
    """
    settings: dict[str, Any] = dict(vars(config))
    if isinstance(config.noise, str):
        settings["noise"] = parse_value(config.noise)  # it may be [shot_var, read_var]
    result = synth(
        pictures,
        out,
        format,
        per_image,
        seed=seed,
        workers=workers,
        max_pixels=max_pixels,
        shard=shard,
        per_shard=per_shard,
        **settings,
    )
    print_synthesis(result)


def print_synthesis(result: Synthesis) -> None:
    """Print the counts of a run as a table, and a line for each picture that cannot be read."""
    head = ("pictures", "pairs made", "existing", "unreadable", "time (s)")
    numbers = (result.pictures, result.made, result.existing, len(result.broken))
    print_rows(str(result.out), head, [[*map(str, numbers), f"{result.seconds:.1f}"]])
    for reason in result.broken.values():
        print(f"Unreadable: {escape(reason)}")
    for line in result.left_out:
        print(line)
