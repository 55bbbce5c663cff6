"""The pairs of a picture: what every format of ``rawaug synth`` writes, and what they were made from.

The draws of a pair depend on (seed, picture's name, number) alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rawaug import __version__
from rawaug.files import find_weights, sha256
from rawaug.io import read_picture
from rawaug.io.pictures import MAX_PIXELS
from rawaug.plugin.config import AugmentConfig, pair_generator
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Target

Format = Literal["dng", "npz", "tiff", "png", "webdataset"]
TARGETS: dict[Format, tuple[Target, ...]] = {"dng": ("raw",), "png": ("srgb",)}
"""What a format can hold; the others hold any target."""


@dataclass(frozen=True)
class Settings:
    """The settings that the files depend on, besides the pictures; stored in ``synth.json`` beside them."""

    format: Format
    config: AugmentConfig
    isp_sha256: str
    seed: int

    def to_json(self) -> dict[str, Any]:
        return {"format": self.format, "isp_sha256": self.isp_sha256, "seed": self.seed, **self.config.to_json()}


@dataclass(frozen=True)
class Origin:
    """What a pair was made from; with its parameters it replays the pair."""

    picture: str
    picture_sha256: str
    isp_sha256: str
    settings: dict[str, Any]
    version: str = __version__


class PairMaker:
    """The pairs of pictures under fixed settings; those with more than ``max_pixels`` are refused."""

    def __init__(self, settings: Settings, max_pixels: int = MAX_PIXELS) -> None:
        self.settings, self.max_pixels = settings, max_pixels
        self.augment = settings.config.make()

    def pairs(self, picture: Path, key: str, numbers: Iterable[int]) -> tuple[Origin, Iterator[tuple[int, RawPair]]]:
        """The origin of a picture's pairs, and an iterator over (number, pair)."""
        before, content = picture.stat(), sha256(picture)
        srgb = trim_to_even(read_picture(picture, self.max_pixels)).contiguous()
        after = picture.stat()
        if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
            raise ValueError(f"{picture}: changed while it was read; run the same command again")

        def made() -> Iterator[tuple[int, RawPair]]:
            for number in numbers:
                params = self.augment.sample(srgb, pair_generator(self.settings.seed, key, number))
                yield number, self.augment.apply(srgb, params)

        return Origin(str(picture), content, self.settings.isp_sha256, self.settings.config.to_json()), made()


def pair_levels(pair: RawPair) -> dict[str, float]:
    noise = pair.params.noise
    return {key: noise[key].item() for key in ("shot_var", "read_var") if key in noise}


def replay_pair(
    params: AugmentParams, origin: Origin, label: object, picture: str | Path | None, isp: str | Path | None
) -> RawPair:
    """Make a pair again from its parameters.

    Args:
        params: those of one pair, without B.
        origin: what the pair was made from.
        label: names the pair in messages.
        picture: the sRGB picture, if it has moved since.
        isp: the ISP's file, if it has moved since.

    Raises:
        ValueError: if the picture or the ISP has changed.
    """
    config, found = AugmentConfig.from_json(origin.settings), Path(picture or origin.picture)
    config = replace(config, isp=str(isp or config.isp))
    if sha256(find_weights(config.isp)) != origin.isp_sha256:
        raise ValueError(f"{label}: the ISP {config.isp} is not the one this pair was made with")
    srgb = trim_to_even(read_picture(found))
    if sha256(found) != origin.picture_sha256:
        raise ValueError(f"{label}: the picture {found} has changed since this pair was made")
    pair: RawPair = config.make().apply(srgb, params)
    return pair
