r"""Clean RAW files as noisy/clean pairs of DNGs, for a training without clean frames whose result can be scored.

    python -m benchmarks.noisy_pairs RAW_DIR OUT [--noise cycleisp_sidd] [--seed 0]

The noise of a frame is drawn once, by (seed, name), as ``rawaug evaluate`` draws it; ``NoiseProfile`` states its
levels. ``--data.pairs pairs:OUT`` reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.measure import parser
from rawaug import bayer
from rawaug.data.folders import RawFolder
from rawaug.evaluation.trials import trial_of
from rawaug.io import read_raw, write_dng
from rawaug.noise import NoiseModel, noise_model
from rawaug.progress import progress

BLACK, WHITE = 16384.0, 65535.0
"""Levels of the written files: black is high enough for the noise of the darkest pixels."""


def write_pair(folder: RawFolder, index: int, noise: NoiseModel, seed: int, out: Path) -> tuple[float, float]:
    """Write ``NAME_clean.dng`` and ``NAME_noisy.dng``; (shot_var, read_var) of the noise.

    Raises:
        ValueError: if the noise is not of the shot and read kind, or 16 bits cannot hold it.
    """
    pair = folder[index]
    trial = trial_of(pair, noise, seed=seed)
    if trial.levels is None:
        raise ValueError(f"{pair.name}: its pair needs noise with known shot_var and read_var, such as a preset")
    frame = replace(read_raw(folder.files[index]), black=(BLACK,) * 4, white=WHITE, noise_profile=None)
    noisy = replace(frame, mosaic=bayer.unpack(trial.noisy, pair.cfa)[0], noise_profile=trial.levels)
    name = pair.name.replace("/", "_")  # a path where two files have the same stem
    write_dng(out / f"{name}_noisy.dng", noisy)
    write_dng(out / f"{name}_clean.dng", frame)
    return trial.levels


def main(argv: Sequence[str] | None = None) -> None:
    cli = parser(__doc__)
    cli.add_argument("data", help="a folder of RAW files")
    cli.add_argument("out", type=Path)
    cli.add_argument("--noise", default="cycleisp_sidd")
    cli.add_argument("--seed", type=int, default=0)
    options = cli.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    folder, noise = RawFolder(options.data, camera_jpeg=False), noise_model(options.noise)
    for index in progress(range(len(folder)), label="pairs", unit="pair"):
        shot_var, read_var = write_pair(folder, index, noise, options.seed, options.out)
        print(f"{folder.names[index]}: shot_var {shot_var:.3g}, read_var {read_var:.3g}")


if __name__ == "__main__":
    main()
