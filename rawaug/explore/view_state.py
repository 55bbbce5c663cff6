"""What the page is set to, the pair that it stands for, and the Python and the command that make this pair."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from rawaug.io import read_picture
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_levels, noise_names
from rawaug.noise.cameras import ProfileLevels
from rawaug.plugin.augment import RawAugment, with_iso
from rawaug.plugin.config import AugmentConfig, pair_generator
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import RawPair
from rawaug.plugin.pictures import trim_to_even
from rawaug.registry import NOISE


@dataclass(frozen=True)
class Look:
    """A picture's file, what is drawn for it, and the seed of the draws, as that of ``rawaug synth``."""

    picture: str
    config: AugmentConfig = field(default_factory=AugmentConfig)
    seed: int = 0


class Example(NamedTuple):
    """The picture uint8 ``(3, H, W)``, the augmentation, and one pair without the leading B."""

    srgb: Tensor
    augment: RawAugment
    pair: RawPair


def make_example(look: Look, number: int = 0) -> Example:
    """The pair of this number, as ``rawaug synth`` makes it of the picture."""
    return _make_example(look, number, Path(look.picture).stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _make_example(look: Look, number: int, changed: int) -> Example:
    srgb, augment = _read_even(look.picture, changed), make_augment(look.config)
    return Example(srgb, augment, augment(srgb, pair_generator(look.seed, Path(look.picture).name, number)))


@lru_cache(maxsize=2)
def _read_even(picture: str, changed: int) -> Tensor:
    """The picture as it is augmented; ``changed`` says which state of the file."""
    return trim_to_even(read_picture(picture))


def make_augment(config: AugmentConfig) -> RawAugment:
    """What :meth:`AugmentConfig.make` makes, from an ISP that is baked once."""
    baked = _baked(AugmentConfig(config.isp, config.camera, target=config.target, burst=config.burst, cfa=config.cfa))
    return baked.with_draws(with_iso(config.noise, config.iso), config.draw)


_baked = lru_cache(maxsize=4)(AugmentConfig.make)


@lru_cache(maxsize=4)
def load_isp(isp: str) -> DictionaryISP:
    return DictionaryISP.from_pretrained(isp)


def tone_names(isp: str) -> list[str]:
    """The tone curves of an ISP; none where its tone is learned."""
    return list(load_isp(isp).info.get("tones", []))


def noise_choices(isp: str) -> list[str]:
    """Noise by name: presets, measured cameras, and the ISP's own where it was measured."""
    own = ["camera"] if "noise" in load_isp(isp).info else []
    return [*own, *(name for name in noise_names() if name not in NOISE)]


def iso_range(noise: str) -> tuple[float, float] | None:
    """Lowest and highest ISO of a camera's noise; None where the noise does not depend on one."""
    if noise == "camera":
        return None
    levels = noise_levels(noise)
    if isinstance(levels, ProfileLevels):
        return round(math.exp(levels.limits[:, 0].min())), round(math.exp(levels.limits[:, 1].max()))
    limits: tuple[float, float] | None = getattr(levels, "iso", None)
    return limits


def drop_inapplicable(config: AugmentConfig) -> AugmentConfig:
    """The settings without those that do not apply to their ISP and noise.

    A fitted ISP has no light, tone and camera to choose, and noise that is not a measured camera's has no ISO.
    """
    if not load_isp(config.isp).config.cameras:
        config = replace(config, camera=None, draw=replace(config.draw, light=None, tone=None))
    elif config.draw.tone not in tone_names(config.isp):
        config = replace(config, draw=replace(config.draw, tone=None))
    if not isinstance(config.noise, str) or iso_range(config.noise) is None:
        config = replace(config, iso=None)
    return config


def command(look: Look, out: str = "pairs") -> str:
    """The command that writes the pair as ``NAME_0.npz``; with ``--per-image 8`` all eight draws of the page.

    Example:
        >>> command(Look("cat.png", AugmentConfig(draw=Draw(light=5500, exposure=-0.5)), seed=3))
        'rawaug synth cat.png pairs --format npz --exposure=-0.5 --light 5500 --seed 3'
    """
    words = ["rawaug", "synth", look.picture, out, "--format", "npz"]
    given = changes(look.config)
    draw = given.pop("draw", None)
    for name, value in {**given, **(changes(draw) if draw else {})}.items():
        text = _text(value)
        words += [f"--{name}={text}"] if text.startswith("-") else [f"--{name}", text]
    return shlex.join([*words, "--seed", str(look.seed)])


def python(look: Look) -> str:
    """The Python that makes the pair.

    Example:
        >>> print(python(Look("cat.png", AugmentConfig(noise="upi", draw=Draw(light=5500)))))
        import rawaug
        from rawaug.io import read_picture
        from rawaug.plugin.config import pair_generator
        <BLANKLINE>
        augment = rawaug.RawAugment.from_pretrained('universal', noise='upi', draw=rawaug.Draw(light=5500))
        pair = augment(read_picture('cat.png'), pair_generator(0, 'cat.png', 0))
    """
    given = {"isp": look.config.isp, **changes(look.config)}
    arguments = ", ".join([repr(given.pop("isp")), *(f"{name}={_code(value)}" for name, value in given.items())])
    return (
        "import rawaug\n"
        "from rawaug.io import read_picture\n"
        "from rawaug.plugin.config import pair_generator\n\n"
        f"augment = rawaug.RawAugment.from_pretrained({arguments})\n"
        f"pair = augment(read_picture({look.picture!r}), pair_generator({look.seed}, {Path(look.picture).name!r}, 0))"
    )


def changes(settings: AugmentConfig | Draw) -> dict[str, Any]:
    """The fields of a dataclass that differ from their defaults."""
    return {f.name: value for f in fields(settings) if (value := getattr(settings, f.name)) != f.default}


def _code(value: object) -> str:
    if not isinstance(value, Draw):
        return repr(value)
    return f"rawaug.Draw({', '.join(f'{name}={one!r}' for name, one in changes(value).items())})"


def _text(value: object) -> str:
    """As an option of the command line: whole numbers without a point, levels as a list."""
    if isinstance(value, tuple):
        return str(list(value))
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)
