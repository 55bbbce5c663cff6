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
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.params import RawPair
from rawaug.plugin.pictures import even_sided
from rawaug.plugin.sampling_config import SamplingConfig, draw_key
from rawaug.registry import NOISE


@dataclass(frozen=True)
class Look:
    """A picture's file, what is drawn for it, and the seed of the draws, as that of ``rawaug synth``."""

    picture: str
    drawing: SamplingConfig = field(default_factory=SamplingConfig)
    seed: int = 0


class Drawn(NamedTuple):
    """The picture uint8 ``(3, H, W)``, the augmentation, and one pair without the leading B."""

    srgb: Tensor
    augment: RawAugment
    pair: RawPair


def drawn(look: Look, number: int = 0) -> Drawn:
    """The pair of this number, as ``rawaug synth`` makes it of the picture."""
    return _drawn(look, number, Path(look.picture).stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _drawn(look: Look, number: int, changed: int) -> Drawn:
    srgb, augment = opened(look.picture, changed), augmentation(look.drawing)
    return Drawn(srgb, augment, augment(srgb, draw_key(look.seed, Path(look.picture).name, number)))


@lru_cache(maxsize=2)
def opened(picture: str, changed: int) -> Tensor:
    """The picture as it is augmented; ``changed`` says which state of the file."""
    return even_sided(read_picture(picture))


def augmentation(drawing: SamplingConfig) -> RawAugment:
    """What :meth:`SamplingConfig.make` makes, from an ISP that is baked once."""
    form = tuple(drawing.form().items())
    return _baked(drawing.isp, drawing.camera, drawing.cfa, form).redrawn(**drawing.draws())


@lru_cache(maxsize=4)
def _baked(isp: str, camera: str | None, cfa: str | None, form: tuple[tuple[str, Any], ...]) -> RawAugment:
    return RawAugment.from_pretrained(loaded(isp), camera=camera, cfa=cfa, **dict(form))


@lru_cache(maxsize=4)
def loaded(isp: str) -> DictionaryISP:
    return DictionaryISP.from_pretrained(isp)


def tones_of(isp: str) -> list[str]:
    """The tone curves of an ISP; none where its tone is learned."""
    return list(loaded(isp).info.get("tones", []))


def noises_of(isp: str) -> list[str]:
    """Noise by name: presets, measured cameras, and the ISP's own where it was measured."""
    own = ["camera"] if "noise" in loaded(isp).info else []
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


def possible(drawing: SamplingConfig) -> SamplingConfig:
    """Without what does not apply: light, tone and camera of a fitted ISP, the ISO of noise that has none."""
    if not loaded(drawing.isp).config.cameras:
        drawing = replace(drawing, camera=None, light=None, tone=None)
    elif drawing.tone not in tones_of(drawing.isp):
        drawing = replace(drawing, tone=None)
    if not isinstance(drawing.noise, str) or iso_range(drawing.noise) is None:
        drawing = replace(drawing, iso=None)
    return drawing


def command(look: Look, out: str = "pairs") -> str:
    """The command that writes the pair as ``NAME_0.npz``; with ``--per-image 8`` all eight draws of the page.

    Example:
        >>> command(Look("cat.png", SamplingConfig(light=5500, exposure=-0.5), seed=3))
        'rawaug synth cat.png pairs --format npz --light 5500 --exposure=-0.5 --seed 3'
    """
    usual, words = SamplingConfig(), ["rawaug", "synth", look.picture, out, "--format", "npz"]
    for name in (option.name for option in fields(SamplingConfig)):
        value = getattr(look.drawing, name)
        if value != getattr(usual, name):
            text = _text(value)
            words += [f"--{name}={text}"] if text.startswith("-") else [f"--{name}", text]
    return shlex.join([*words, "--seed", str(look.seed)])


def python(look: Look) -> str:
    """The Python that makes the pair.

    Example:
        >>> print(python(Look("cat.png", SamplingConfig(light=5500))))
        import rawaug
        from rawaug.io import read_picture
        from rawaug.plugin.sampling_config import draw_key
        <BLANKLINE>
        augment = rawaug.RawAugment.from_pretrained('universal', noise='cycleisp_sidd', light=5500)
        pair = augment(read_picture('cat.png'), draw_key(0, 'cat.png', 0))
    """
    arguments = "".join(f", {name}={value!r}" for name, value in look.drawing.arguments().items())
    made = f"rawaug.RawAugment.from_pretrained({look.drawing.isp!r}{arguments})"
    key = f"draw_key({look.seed}, {Path(look.picture).name!r}, 0)"
    return (
        "import rawaug\n"
        "from rawaug.io import read_picture\n"
        "from rawaug.plugin.sampling_config import draw_key\n\n"
        f"augment = {made}\n"
        f"pair = augment(read_picture({look.picture!r}), {key})"
    )


def _text(value: object) -> str:
    """As an option of the command line: whole numbers without a point, levels as a list."""
    if isinstance(value, tuple):
        return str(list(value))
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)
