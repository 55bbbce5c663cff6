"""The ISP ``phones``: ``python -m benchmarks.phones PHOTOGRAPHS --out phones.safetensors``.

Frames of the five simulated phones (:mod:`rawaug.data.phones`), one of each training instance, are drawn anew for
several seeds; the published fit learns dictionaries, encoders and both masks on them end to end.
"""

from __future__ import annotations

from collections.abc import Sequence

from rawaug.data.pairs import LazyPairs, Pair, SomePairs
from rawaug.data.phones import PhoneFrames
from rawaug.isp.fit import FitConfig, fit_isp

SIZE = (256, 256)
FEWEST_BRIGHT = 0.1
"""Frames with a smaller share of unclipped pixels say nothing of their colour."""


class Draws(LazyPairs):
    """The first frames of the training instances of several seeds, without frames that are nearly black or white."""

    def __init__(self, path: str, seeds: Sequence[int]) -> None:
        parts = [PhoneFrames(path, "train", seed, SIZE) for seed in seeds]
        self.parts = [SomePairs(part, range(0, len(part), 2)) for part in parts]
        places = [
            (seed, part, index) for seed, part in zip(seeds, self.parts, strict=True) for index in range(len(part))
        ]
        self.places = []
        for seed, part, index in places:
            srgb = part[index].srgb
            unclipped = (srgb.amax(0) < 250) & (srgb.amin(0) > 0)
            if unclipped.float().mean() >= FEWEST_BRIGHT:
                self.places.append((seed, part, index))
        super().__init__([f"{part.names[index]} of seed {seed}" for seed, part, index in self.places])

    def read(self, index: int) -> Pair:
        _, part, place = self.places[index]
        return part[place]


def main(
    photographs: str, /, *, out: str, seeds: int = 3, steps: int = 2000, pixels: int = 4096, raw_loss: str = "log"
) -> None:
    """Fit the ISP and print what held-out frames gained.

    Args:
        photographs: folder with a subfolder ``train``.
        out: the .safetensors file to write.
        seeds: how often the 160 instances are drawn.
        steps: of the training end to end.
        pixels: kept of each frame.
        raw_loss: l2 or log.
    """
    frames = Draws(photographs, range(1, seeds + 1))
    config = FitConfig(
        method="published",
        steps=100,
        joint_steps=steps,
        pixels=pixels,
        batch=512,
        raw_loss=raw_loss,  # type: ignore[arg-type]
    )
    isp = fit_isp(frames, config)
    isp.info["rendering"] = "phones: (simulated)"
    isp.info["frames"] = [f"phones: of seeds 1 to {seeds}, {len(frames)} training instances"]
    isp.save(out)
    print(isp.info["joint"])


if __name__ == "__main__":
    from cyclopts import run

    run(main)
