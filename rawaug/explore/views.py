"""The views of the page: functions that make titled pictures of a :class:`Look`, in :data:`VIEWS` by the tab's name.

Noisy and clean are shown pixel by pixel; of a large picture the central part is shown. RAW is demosaiced bilinearly and
developed by the ISP's forward pass with the setting of the draw. The eight draws are all developed with the setting of
the first, so that cameras, lights and exposures can be seen to differ. Python and a command make the pair again.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from denoisers.files import DEFAULT
from denoisers.network import PACKED
from rawaug.bayer import CFA, pattern
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.pictures import PICTURES, PictureDenoiser
from rawaug.explore import figures
from rawaug.explore.figures import Example
from rawaug.io import encode_srgb, read_picture
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import frame_coordinates
from rawaug.metrics import psnr
from rawaug.noise import noise_levels, noise_names
from rawaug.noise.cameras import ProfileLevels
from rawaug.noise.models import NOISE
from rawaug.plugin.augment import RawAugment, with_iso
from rawaug.plugin.config import AugmentConfig, pair_generator
from rawaug.plugin.draw import Draw
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Srgb

DRAWS = 8
HEIGHT, WIDTH = 512, 768
"""Largest part of a picture that is shown pixel by pixel."""
_WHOLE_CELLS = 12  # parts begin at multiples of it, where the cells of all patterns do
_THUMBNAIL = 384
_ZOOM = (24, 36)
_SCALE = 8


@dataclass(frozen=True)
class Look:
    """The settings of the page: a picture's file, the settings of its pair, and the seed, as of ``rawaug synth``."""

    picture: str
    config: AugmentConfig = field(default_factory=AugmentConfig)
    seed: int = 0


def make_example(look: Look) -> Example:
    """Make the first pair of the picture, as ``rawaug synth`` makes it."""
    return _make_example(look, Path(look.picture).stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _make_example(look: Look, changed: int) -> Example:
    srgb, augment = _read_even(look.picture, changed), make_augment(look.config)
    return Example(srgb, augment, augment(srgb, pair_generator(look.seed, Path(look.picture).name, 0)))


@lru_cache(maxsize=2)
def _read_even(picture: str, changed: int) -> Tensor:
    """The picture as it is augmented; ``changed`` stands for the state of the file."""
    return trim_to_even(read_picture(picture))


def make_augment(config: AugmentConfig) -> RawAugment:
    """Make what :meth:`AugmentConfig.make` makes, but bake an ISP only once."""
    baked = _baked(AugmentConfig(config.isp, config.camera, target=config.target, burst=config.burst, cfa=config.cfa))
    return baked.with_draws(with_iso(config.noise, config.iso), config.draw)


_baked = lru_cache(maxsize=4)(AugmentConfig.make)


@lru_cache(maxsize=4)
def load_isp(isp: str) -> DictionaryISP:
    """An ISP by its name or path, which is kept in memory."""
    return DictionaryISP.from_pretrained(isp)


def tone_names(isp: str) -> list[str]:
    """The names of an ISP's tone curves; it has none where its tone is learned."""
    return list(load_isp(isp).info.get("tones", []))


def noise_choices(isp: str) -> list[str]:
    """The names of noise: presets, measured cameras, and ``camera`` where the ISP's own was measured."""
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
    options: dict[str, Any] = {}
    for name, value in changes(look.config).items():
        prefix = "" if isinstance(value, Draw) else f"{name}."
        options |= {prefix + key: one for key, one in changes(value).items()} if is_dataclass(value) else {name: value}
    for name, value in options.items():
        text = "" if value is True else _text(value)
        words += [f"--{name}={text}"] if text.startswith("-") else [f"--{name}", text] if text else [f"--{name}"]
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
    arguments = ", ".join([repr(given.pop("isp")), *(f"{name}={_as_code(value)}" for name, value in given.items())])
    return (
        "import rawaug\n"
        "from rawaug.io import read_picture\n"
        "from rawaug.plugin.config import pair_generator\n\n"
        f"augment = rawaug.RawAugment.from_pretrained({arguments})\n"
        f"pair = augment(read_picture({look.picture!r}), pair_generator({look.seed}, {Path(look.picture).name!r}, 0))"
    )


def changes(settings: Any) -> dict[str, Any]:
    """The fields of a dataclass that differ from their defaults."""
    return {f.name: value for f in fields(settings) if (value := getattr(settings, f.name)) != f.default}


def _as_code(value: object) -> str:
    if not is_dataclass(value):
        return repr(value)
    return f"rawaug.{type(value).__name__}({', '.join(f'{name}={one!r}' for name, one in changes(value).items())})"


def _text(value: object) -> str:
    """A value as the command line takes it: whole numbers without a point, levels as a list."""
    if isinstance(value, tuple):
        return str(list(value))
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


class Panel(NamedTuple):
    """A picture, uint8 ``(H, W, 3)``, and its title."""

    title: str
    image: np.ndarray


def pair(look: Look) -> list[Panel]:
    """The noisy and the clean RAW of the picture, developed; the PSNR is that of the RAW."""
    made = make_example(look)
    noisy, clean = (_crop(raw) for raw in (made.pair.noisy, made.pair.clean))
    quality = psnr(noisy[None], clean[None]).item()
    shown = [_develop(made, raw) for raw in (noisy, clean)]
    return [Panel(f"noisy: {_levels(made)}; {quality:.1f} dB", shown[0]), Panel(f"clean: {_setting(made)}", shown[1])]


@torch.no_grad()
def stages(look: Look) -> list[Panel]:
    """The picture between the stages of the ISP, small; linear images through the sRGB curve."""
    made = make_example(look)
    factor = max(1, max(made.srgb.shape[-2:]) // _THUMBNAIL)
    small = trim_to_even(F.avg_pool2d(made.srgb[None].float(), factor)[0].round().to(torch.uint8))
    shown = stage_pictures(made.augment, small, _as_batch(made.pair.params.isp))
    return [Panel(title, _to_uint8(image)) for title, image in shown.items()]


def stage_pictures(
    augment: RawAugment, srgb: Tensor, setting: ISPParams | None, place: Tensor | None = None
) -> dict[str, Tensor]:
    """Show what the stages of an ISP make of a picture.

    Args:
        augment: its ISP and pattern are used.
        srgb: the picture, uint8 ``(3, H, W)``.
        setting: the camera setting, with B = 1; the ISP chooses it by default.
        place: coordinates of the pixels in the full frame, ``(1, 2, H, W)``; those of a full frame by default.

    Returns:
        By title pictures ``(3, H, W)`` in [0, 1], linear ones through the sRGB curve.
    """
    result = augment.isp.reverse(srgb[None], setting, coordinates=place, intermediates=True)
    names = {f"x{stage.makes}": stage.name for stage in augment.isp.ordered_stages}
    shown = {"sRGB x": srgb / 255.0}
    image = srgb[None]
    for name, image in result.intermediates.items():
        linear = image[0].clamp(0, 1)
        shown[f"{name}: {names[name]}"] = linear if name == "x1" else encode_srgb(linear)
    sensor = pattern(augment.cfa)
    mosaic = sensor.mosaic(image)
    return shown | {f"RAW y: {sensor.name}, demosaiced": encode_srgb(sensor.demosaic(mosaic)[0].clamp(0, 1))}


def raw(look: Look) -> list[Panel]:
    """The mosaic magnified, histograms of clean and noisy RAW, and the packed planes."""
    made = make_example(look)
    mosaic = made.augment.mosaic(made.pair.noisy)
    sensor = pattern(made.augment.cfa)
    near = _crop(mosaic, _ZOOM)
    values = made.pair.clean.flatten()
    gains = 1.0 / values[:: max(1, len(values) // 2**14)].quantile(0.99).clamp_min(1e-3)
    coloured = sensor.planes(*near.shape[-2:]) * encode_srgb((near * gains).clamp(0, 1))
    sites = _to_uint8(coloured).repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)
    panels = [
        Panel(f"{sensor.name}: {near.shape[-2]} x {near.shape[-1]} sites, each in its colour", sites),
        Panel("histograms", figures.histograms(made)),
    ]
    if made.augment.pattern is None:
        for name, plane in zip(("R", "Gr", "Gb", "B"), _crop(made.pair.noisy), strict=True):
            panels.append(
                Panel(f"packed {name}", _to_uint8(encode_srgb((plane * gains).clamp(0, 1)).expand(3, -1, -1)))
            )
    return panels


def camera(look: Look) -> list[Panel]:
    """The drawn tone curve and colours, over the atoms of the ISP that they are mixed from."""
    made = make_example(look)
    return [
        Panel(_setting(made), figures.tone_curve(made)),
        Panel("large: red, green, blue, skin and sky by the drawn matrix; small: by the atoms", figures.colours(made)),
    ]


def noise(look: Look) -> list[Panel]:
    """Measured variance of the noise against the law that it was drawn from."""
    made = make_example(look)
    return [Panel(f"noise of the pair and its law: {_levels(made)}", figures.noise(made))]


@torch.no_grad()
def draws(look: Look) -> list[Panel]:
    """Eight draws of camera, light, exposure and noise for the central part, at half size."""
    first = make_example(look)
    augment, part, panels = first.augment, _crop(first.srgb), []
    top, left, *_ = _centre(first.srgb)
    place = torch.tensor([[top, left, *first.srgb.shape[-2:], 0]])
    for number in range(DRAWS):
        params = augment.sample(part[None], pair_generator(look.seed, Path(look.picture).name, number), place)
        made = Example(part, augment, augment.apply(part[None], params).map(lambda tensor: tensor[0]))
        panels.append(Panel(f"draw {number}: {_setting(made)}; {_levels(made)}", _develop(first, _half(made), 2)))
    return panels


def denoise(look: Look) -> list[Panel]:
    """Noisy on the left, denoised by the shipped network on the right, both developed."""
    made = make_example(look)
    if made.augment.pattern is not None:
        raise ValueError(f"{DEFAULT} denoises Bayer RAW, not {made.augment.cfa}; choose a Bayer CFA")
    cfa = CFA(made.augment.cfa)
    noisy, clean, variance = (_crop(x)[None] for x in (made.pair.noisy, made.pair.clean, made.pair.variance))
    result = _network()(Noisy(noisy, variance, cfa=cfa)).clamp(max=1.0)
    before, after = (psnr(x, clean).item() for x in (noisy, result))
    shown = [_develop(made, x[0]) for x in (noisy, result)]
    return [Panel(f"noisy, {before:.1f} dB", shown[0]), Panel(f"denoised by {DEFAULT}, {after:.1f} dB", shown[1])]


def srgb(look: Look) -> list[Panel]:
    """Noisy and clean as a camera's JPEG, developed and finished by the camera that made the RAW; denoised, too."""
    made = make_example(look)
    noisy, clean = (_crop(image) for image in (made.pair.noisy, made.pair.clean))
    quality = psnr(noisy[None], clean[None]).item()
    assert made.augment.srgb is not None
    method = made.augment.srgb.methods[int(made.pair.params.extras["demosaicing"])]
    title = f"noisy: {_levels(made)}, demosaicing {method}; {quality:.1f} dB"
    denoised = _picture_network()(Noisy(noisy[None]))
    after = f"denoised by {PICTURES}, told no level; {psnr(denoised, clean[None]).item():.1f} dB"
    shown = {title: noisy, after: denoised[0], "clean: developed and finished alike": clean}
    return [Panel(name, _to_uint8(image)) for name, image in shown.items()]


def burst(look: Look) -> list[Panel]:
    """Noisy frames of the scene from a hand that moves, each with noise of its own."""
    made = make_example(look)
    panels = []
    for k, (down, right, angle) in enumerate(made.pair.params.extras["motion"].tolist()):
        moved = f"{down:+.1f} pixels down, {right:+.1f} to the right, turned by {math.degrees(angle):+.2f} degrees"
        panels.append(Panel(f"frame {k}: {moved}", _develop(made, _crop(made.pair.noisy[k]))))
    return panels


VIEWS: dict[str, Callable[[Look], list[Panel]]] = {
    "Pair": pair,
    "Stages": stages,
    "RAW": raw,
    "Camera": camera,
    "Noise": noise,
    "Eight draws": draws,
    "sRGB": srgb,
    "Burst": burst,
}
"""The tabs; beside them there is the one that compares the noisy picture with the denoised one."""
FORMS: dict[str, dict[str, Any]] = {"sRGB": {"target": Srgb(finish=True)}, "Burst": {"burst": 4}}
"""Target and burst of the pairs that a tab shows, if not those of the others."""


def with_tab(tab: str, look: Look) -> Look:
    """The look with the target and the burst that a tab shows."""
    return replace(look, config=replace(look.config, **FORMS.get(tab, {})))


@lru_cache(maxsize=1)
def _network() -> RawDenoiser:
    return RawDenoiser.of(DEFAULT)


@lru_cache(maxsize=1)
def _picture_network() -> PictureDenoiser:
    return PictureDenoiser.of(PICTURES)


def _half(made: Example) -> Tensor:
    """Noisy RAW in three colours at half the size, ``(3, H/2, W/2)``: one pixel for each cell of a Bayer pattern."""
    noisy = made.pair.noisy
    if made.augment.pattern is None:
        return torch.stack([noisy[0], (noisy[1] + noisy[2]) / 2, noisy[3]])
    return F.avg_pool2d(made.augment.pattern.demosaic(noisy[None]), 2)[0]


def _setting(made: Example) -> str:
    """The white balance of the draw, and the mean of its RAW, in words."""
    red, green, blue = (made.pair.params.isp.gains / made.pair.params.isp.gains[1]).tolist()
    return f"white balance {red:.2f}, {green:.0f}, {blue:.2f}; mean {made.pair.clean.mean().item():.3f}"


def _levels(made: Example) -> str:
    levels = made.pair.params.noise
    if not {"shot_var", "read_var"} <= levels.keys():
        return "noise without levels"
    return f"shot_var {levels['shot_var'].item():.2e}, read_var {levels['read_var'].item():.2e}"


@torch.no_grad()
def _develop(made: Example, part: Tensor, scale: int = 1) -> np.ndarray:
    """Develop the central part of RAW, or of linear RGB at 1 / ``scale`` of the size, by the setting of a draw."""
    rgb = part if scale > 1 else pattern(made.augment.cfa).demosaic(made.augment.mosaic(part)[None])[0]
    top, left, height, width = (place // scale for place in (*_centre(made.srgb)[:2], *made.srgb.shape[-2:]))
    place = frame_coordinates(rgb.shape[-2], rgb.shape[-1], (top, left), (height, width))
    return _to_uint8(made.augment.isp.forward_pixels(rgb[None], _as_batch(made.pair.params.isp), place)[0])


def _as_batch(setting: ISPParams) -> ISPParams:
    return ISPParams(*(value[None] for value in setting))


def _centre(image: Tensor, size: tuple[int, int] = (HEIGHT, WIDTH)) -> tuple[int, int, int, int]:
    """Top, left, height and width of the central part of at most this size, in pixels of the mosaic."""
    scale = 2 if image.shape[-3] == PACKED else 1
    sides = [scale * side for side in image.shape[-2:]]
    height, width = (min(side, most) for side, most in zip(sides, size, strict=True))
    step = 2 * _WHOLE_CELLS
    top, left = ((side - part) // step * _WHOLE_CELLS for side, part in zip(sides, (height, width), strict=True))
    return top, left, height, width


def _crop(image: Tensor, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Tensor:
    scale = 2 if image.shape[-3] == PACKED else 1
    top, left, height, width = (place // scale for place in _centre(image, size))
    return image[..., top : top + height, left : left + width]


def _to_uint8(image: Tensor) -> np.ndarray:
    """Floats ``(3, H, W)`` in [0, 1] to uint8 ``(H, W, 3)``."""
    shown: np.ndarray = (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    return np.ascontiguousarray(shown)
