"""The views of the page: functions that make titled pictures of a :class:`Look`, in :data:`VIEWS` by the tab's name.

Noisy and clean are shown pixel by pixel; for a large picture, the central part is shown. RAW is demosaiced bilinearly
and developed by the ISP's forward pass with the setting of the draw. The eight draws are all developed with the setting
of the first, so that differences in camera, light and exposure can be seen. The Python code and the command that are
shown make the pair again.
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

from rawaug import bayer
from rawaug.bayer import CFA, pattern
from rawaug.denoising.denoiser import ImageDenoiser, Noisy, RawDenoiser
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.explore import figures
from rawaug.explore.figures import Example
from rawaug.io import encode_srgb, read_picture
from rawaug.isp.config import ISPParams
from rawaug.isp.functional import frame_coordinates
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.noise import noise_levels, noise_names
from rawaug.noise.models import NOISE
from rawaug.noise.profiles import ProfileLevels
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.camera_noise import with_iso
from rawaug.plugin.config import AugmentConfig, pair_generator
from rawaug.plugin.draw import Draw
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Srgb

DRAWS = 8
"""This many draws are shown side by side."""

HEIGHT, WIDTH = 512, 768
"""The part of a picture that is shown pixel by pixel has at most this height and width."""

_WHOLE_CELLS = 12
"""Parts begin at multiples of this, where the cells of all patterns begin."""

_THUMBNAIL = 384
"""The longer side of the pictures between the stages has this length."""

_ZOOM = (24, 36)
"""The part of the mosaic that is magnified has this height and width."""

_SCALE = 8
"""That part is magnified this many times."""


@dataclass(frozen=True)
class Look:
    """The settings of the page: a picture's file, the settings of its pair, and the seed, as in ``rawaug synth``."""

    picture: str
    config: AugmentConfig = field(default_factory=AugmentConfig)
    seed: int = 0


def make_example(look: Look) -> Example:
    """Make the first pair of the picture, as ``rawaug synth`` makes it."""
    return _make_example(look, Path(look.picture).stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _make_example(look: Look, changed: int) -> Example:
    srgb = _read_even(look.picture, changed)
    augment = make_augment(look.config)
    pair = augment(srgb, pair_generator(look.seed, Path(look.picture).name, 0))
    return Example(srgb, augment, pair)


@lru_cache(maxsize=2)
def _read_even(picture: str, changed: int) -> Tensor:
    """Read a picture with even sides; ``changed`` stands for the state of the file."""
    return trim_to_even(read_picture(picture))


def make_augment(config: AugmentConfig) -> RawAugment:
    """Make an augmentation as :meth:`AugmentConfig.make` does, but bake each ISP only once."""
    baked = _baked(AugmentConfig(config.isp, config.camera, target=config.target, burst=config.burst, cfa=config.cfa))
    return baked.with_draws(with_iso(config.noise, config.iso), config.draw)


_baked = lru_cache(maxsize=4)(AugmentConfig.make)


@lru_cache(maxsize=4)
def load_isp(isp: str) -> DictionaryISP:
    """Load an ISP by its name or path; it is kept in memory."""
    return DictionaryISP.from_pretrained(isp)


def tone_names(isp: str) -> list[str]:
    """List the names of an ISP's tone curves; an ISP with a learned tone has none."""
    return list(load_isp(isp).info.get("tones", []))


def noise_choices(isp: str) -> list[str]:
    """List the names of noise: presets, measured cameras, and ``camera`` if the ISP's own was measured."""
    names = [name for name in noise_names() if name not in NOISE]
    if "noise" in load_isp(isp).info:
        names.insert(0, "camera")
    return names


def iso_range(noise: str) -> tuple[float, float] | None:
    """Get the lowest and the highest ISO of a camera's noise; return None if the noise does not depend on ISO."""
    if noise == "camera":
        return None

    levels = noise_levels(noise)
    if isinstance(levels, ProfileLevels):
        return round(math.exp(levels.limits[:, 0].min())), round(math.exp(levels.limits[:, 1].max()))
    limits: tuple[float, float] | None = getattr(levels, "iso", None)
    return limits


def drop_inapplicable(config: AugmentConfig) -> AugmentConfig:
    """Leave out the settings that do not apply to their ISP and noise.

    A fitted ISP has no light, tone or camera to choose, and noise that is not a measured camera's has no ISO.
    """
    if not load_isp(config.isp).config.cameras:
        config = replace(config, camera=None, draw=replace(config.draw, light=None, tone=None))
    elif config.draw.tone not in tone_names(config.isp):
        config = replace(config, draw=replace(config.draw, tone=None))
    if not isinstance(config.noise, str) or iso_range(config.noise) is None:
        config = replace(config, iso=None)
    return config


def command(look: Look, out: str = "pairs") -> str:
    """Give the command that writes the pair as ``NAME_0.npz``; with ``--per-image 8`` it writes all eight draws.

    Example:
        >>> command(Look("cat.png", AugmentConfig(draw=Draw(light=5500, exposure=-0.5)), seed=3))
        'rawaug synth cat.png pairs --format npz --noise cycleisp_sidd --exposure=-0.5 --light 5500 --seed 3'
    """
    options: dict[str, Any] = {}
    for name, value in changes(look.config).items():
        if not is_dataclass(value):
            options[name] = value
            continue
        prefix = "" if isinstance(value, Draw) else f"{name}."
        for key, inner in changes(value).items():
            options[prefix + key] = inner

    words = ["rawaug", "synth", look.picture, out, "--format", "npz"]
    for name, value in options.items():
        text = _text(value)
        if value is True:
            words.append(f"--{name}")
        elif text.startswith("-"):
            words.append(f"--{name}={text}")
        else:
            words += [f"--{name}", text]
    return shlex.join([*words, "--seed", str(look.seed)])


def python(look: Look) -> str:
    """Give the Python code that makes the pair.

    Example:
        >>> print(python(Look("cat.png", AugmentConfig(noise="upi", draw=Draw(light=5500)))))
        import rawaug
        from rawaug.io import read_picture
        from rawaug.plugin.config import pair_generator
        <BLANKLINE>
        augment = rawaug.RawAugment.from_pretrained('universal', noise='upi', draw=rawaug.Draw(light=5500))
        pair = augment(read_picture('cat.png'), pair_generator(0, 'cat.png', 0))
    """
    arguments = repr(look.config.isp)
    for name, value in changes(look.config).items():
        if name != "isp":
            arguments += f", {name}={_as_code(value)}"
    return (
        "import rawaug\n"
        "from rawaug.io import read_picture\n"
        "from rawaug.plugin.config import pair_generator\n\n"
        f"augment = rawaug.RawAugment.from_pretrained({arguments})\n"
        f"pair = augment(read_picture({look.picture!r}), pair_generator({look.seed}, {Path(look.picture).name!r}, 0))"
    )


def changes(settings: Any) -> dict[str, Any]:
    """Get the fields of a dataclass that differ from their defaults."""
    values = {}
    for field_ in fields(settings):
        value = getattr(settings, field_.name)
        if value != field_.default:
            values[field_.name] = value
    return values


def _as_code(value: object) -> str:
    if not is_dataclass(value):
        return repr(value)
    arguments = [f"{name}={inner!r}" for name, inner in changes(value).items()]
    return f"rawaug.{type(value).__name__}({', '.join(arguments)})"


def _text(value: object) -> str:
    """Write a value as the command line takes it: whole numbers without a point, levels as a list."""
    if isinstance(value, tuple):
        return str(list(value))
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    return str(value)


class Panel(NamedTuple):
    """A picture, uint8 ``(H, W, 3)``, and its title."""

    title: str
    image: np.ndarray


def pair(look: Look) -> list[Panel]:
    """The noisy and the clean RAW of the picture, developed; the PSNR is that of the RAW."""
    example = make_example(look)
    noisy, clean = _crop(example.pair.noisy), _crop(example.pair.clean)
    quality = psnr(noisy[None], clean[None]).item()
    return [
        Panel(f"noisy: {_levels(example)}; {quality:.1f} dB", _develop(example, noisy)),
        Panel(f"clean: {_setting(example)}", _develop(example, clean)),
    ]


@torch.no_grad()
def stages(look: Look) -> list[Panel]:
    """The picture between the stages of the ISP, small; linear images through the sRGB curve."""
    example = make_example(look)
    factor = max(1, max(example.srgb.shape[-2:]) // _THUMBNAIL)
    means = F.avg_pool2d(example.srgb[None].float(), factor)[0]
    small = trim_to_even(means.round().to(torch.uint8))

    pictures = stage_pictures(example.augment, small, _as_batch(example.pair.params.isp))
    return [Panel(title, _to_uint8(image)) for title, image in pictures.items()]


def stage_pictures(
    augment: RawAugment, srgb: Tensor, setting: ISPParams | None, place: Tensor | None = None
) -> dict[str, Tensor]:
    """Show what each stage of an ISP makes of a picture.

    Args:
        augment: the augmentation whose ISP and pattern are used.
        srgb: the picture, uint8 ``(3, H, W)``.
        setting: the camera setting, with B = 1; the ISP chooses it by default.
        place: coordinates of the pixels in the full frame, ``(1, 2, H, W)``; those of a full frame by default.

    Returns:
        Pictures ``(3, H, W)`` in [0, 1] by title; linear ones are shown through the sRGB curve.
    """
    result = augment.isp.reverse(srgb[None], setting, coordinates=place, intermediates=True)
    stage_of = {f"x{stage.makes}": stage.name for stage in augment.isp.stages.ordered}

    pictures = {"sRGB x": srgb / 255.0}
    image = srgb[None]
    for name, image in result.intermediates.items():
        picture = image[0].clamp(0, 1)
        if name != "x1":
            picture = encode_srgb(picture)
        pictures[f"{name}: {stage_of[name]}"] = picture

    sensor = pattern(augment.cfa)
    demosaiced = sensor.demosaic(sensor.mosaic(image))[0]
    pictures[f"RAW y: {sensor.name}, demosaiced"] = encode_srgb(demosaiced.clamp(0, 1))
    return pictures


def raw(look: Look) -> list[Panel]:
    """The mosaic magnified, histograms of clean and noisy RAW, and the packed planes."""
    example = make_example(look)
    mosaic = example.augment.mosaic(example.pair.noisy)
    sensor = pattern(example.augment.cfa)
    near = _crop(mosaic, _ZOOM)

    values = example.pair.clean.flatten()
    some = values[:: max(1, len(values) // 2**14)]
    gains = 1.0 / some.quantile(0.99).clamp_min(1e-3)
    coloured = sensor.planes(*near.shape[-2:]) * encode_srgb((near * gains).clamp(0, 1))
    sites = _to_uint8(coloured).repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)
    panels = [
        Panel(f"{sensor.name}: {near.shape[-2]} x {near.shape[-1]} sites, each in its colour", sites),
        Panel("histograms", figures.histograms(example)),
    ]
    if example.augment.pattern is None:
        for name, plane in zip(("R", "Gr", "Gb", "B"), _crop(example.pair.noisy), strict=True):
            grey = encode_srgb((plane * gains).clamp(0, 1))
            panels.append(Panel(f"packed {name}", _to_uint8(grey.expand(3, -1, -1))))
    return panels


def camera(look: Look) -> list[Panel]:
    """The drawn tone curve and colours, over the atoms of the ISP that they are mixed from."""
    example = make_example(look)
    return [
        Panel(_setting(example), figures.tone_curve(example)),
        Panel(
            "large: red, green, blue, skin and sky by the drawn matrix; small: by the atoms", figures.colours(example)
        ),
    ]


def noise(look: Look) -> list[Panel]:
    """Measured variance of the noise against the law that it was drawn from."""
    example = make_example(look)
    return [Panel(f"noise of the pair and its law: {_levels(example)}", figures.noise(example))]


@torch.no_grad()
def draws(look: Look) -> list[Panel]:
    """Eight draws of camera, light, exposure and noise for the central part, at half size."""
    first = make_example(look)
    augment, part = first.augment, _crop(first.srgb)
    top, left, *_ = _centre(first.srgb)
    place = torch.tensor([[top, left, *first.srgb.shape[-2:], 0]])

    panels = []
    for number in range(DRAWS):
        params = augment.sample(part[None], pair_generator(look.seed, Path(look.picture).name, number), place)
        example = Example(part, augment, augment.apply(part[None], params).map(lambda tensor: tensor[0]))
        title = f"draw {number}: {_setting(example)}; {_levels(example)}"
        panels.append(Panel(title, _develop(first, _half(example), 2)))
    return panels


def denoise(look: Look) -> list[Panel]:
    """Noisy on the left, denoised by the shipped network on the right, both developed."""
    example = make_example(look)
    if example.augment.pattern is not None:
        raise ValueError(f"{RawDenoiser.default} denoises Bayer RAW, not {example.augment.cfa}; choose a Bayer CFA")

    pair = example.pair
    noisy, clean, variance = _crop(pair.noisy)[None], _crop(pair.clean)[None], _crop(pair.variance)[None]
    denoised = _shipped(RawDenoiser)(Noisy(noisy, variance, cfa=CFA(example.augment.cfa))).clamp(max=1.0)
    before, after = psnr(noisy, clean).item(), psnr(denoised, clean).item()
    return [
        Panel(f"noisy, {before:.1f} dB", _develop(example, noisy[0])),
        Panel(f"denoised by {RawDenoiser.default}, {after:.1f} dB", _develop(example, denoised[0])),
    ]


def srgb(look: Look) -> list[Panel]:
    """Noisy and clean as a camera's JPEG, developed and finished by the camera that made the RAW; denoised, too."""
    example = make_example(look)
    noisy, clean = _crop(example.pair.noisy), _crop(example.pair.clean)
    quality = psnr(noisy[None], clean[None]).item()
    assert example.augment.srgb is not None
    method = example.augment.srgb.methods[int(example.pair.params.extras["demosaicing"])]

    denoised = _shipped(PictureDenoiser)(Noisy(noisy[None]))[0]
    after = psnr(denoised[None], clean[None]).item()
    return [
        Panel(f"noisy: {_levels(example)}, demosaicing {method}; {quality:.1f} dB", _to_uint8(noisy)),
        Panel(f"denoised by {PictureDenoiser.default} without a level; {after:.1f} dB", _to_uint8(denoised)),
        Panel("clean: developed and finished alike", _to_uint8(clean)),
    ]


def burst(look: Look) -> list[Panel]:
    """Noisy frames of the scene from a hand that moves, each with noise of its own."""
    example = make_example(look)
    panels = []
    for k, (down, right, angle) in enumerate(example.pair.params.extras["motion"].tolist()):
        moved = f"{down:+.1f} pixels down, {right:+.1f} to the right, turned by {math.degrees(angle):+.2f} degrees"
        panels.append(Panel(f"frame {k}: {moved}", _develop(example, _crop(example.pair.noisy[k]))))
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
"""These are the tabs, except for the one that compares the noisy picture with the denoised one."""

FORMS: dict[str, dict[str, Any]] = {"sRGB": {"target": Srgb(finish=True)}, "Burst": {"burst": 4}}
"""These tabs need a target or a burst of their own."""


def with_tab(tab: str, look: Look) -> Look:
    """Set the target and the burst that a tab shows."""
    return replace(look, config=replace(look.config, **FORMS.get(tab, {})))


@lru_cache(maxsize=2)
def _shipped(kind: type[ImageDenoiser]) -> ImageDenoiser:
    """Return the shipped denoiser of a kind of image."""
    return kind.of(kind.default)


def _half(example: Example) -> Tensor:
    """Halve noisy RAW to three colours, ``(3, H/2, W/2)``, one pixel for each cell of a Bayer pattern."""
    noisy = example.pair.noisy
    if example.augment.pattern is None:
        return torch.stack([noisy[0], (noisy[1] + noisy[2]) / 2, noisy[3]])
    return F.avg_pool2d(example.augment.pattern.demosaic(noisy[None]), 2)[0]


def _setting(example: Example) -> str:
    """Describe the white balance of the draw and the mean of its RAW in words."""
    gains = example.pair.params.isp.gains
    red, green, blue = (gains / gains[1]).tolist()
    return f"white balance {red:.2f}, {green:.0f}, {blue:.2f}; mean {example.pair.clean.mean().item():.3f}"


def _levels(example: Example) -> str:
    levels = example.pair.params.noise
    if not {"shot_var", "read_var"} <= levels.keys():
        return "noise without levels"
    return f"shot_var {levels['shot_var'].item():.2e}, read_var {levels['read_var'].item():.2e}"


@torch.no_grad()
def _develop(example: Example, part: Tensor, scale: int = 1) -> np.ndarray:
    """Develop the central part of RAW, or of linear RGB at 1 / ``scale`` of the size, by the setting of a draw."""
    augment = example.augment
    rgb = part
    if scale == 1:
        rgb = pattern(augment.cfa).demosaic(augment.mosaic(part)[None])[0]

    top, left, *_ = _centre(example.srgb)
    height, width = example.srgb.shape[-2:]
    corner, frame = (top // scale, left // scale), (height // scale, width // scale)
    place = frame_coordinates(rgb.shape[-2], rgb.shape[-1], corner, frame)
    return _to_uint8(augment.isp.stages.forward(rgb[None], _as_batch(example.pair.params.isp), place)[0])


def _as_batch(setting: ISPParams) -> ISPParams:
    return ISPParams(*(value[None] for value in setting))


def _centre(image: Tensor, size: tuple[int, int] = (HEIGHT, WIDTH)) -> tuple[int, int, int, int]:
    """Compute top, left, height and width of the central part of at most this size, in pixels of the mosaic."""
    scale = bayer.sites_per_value(image)
    full_height, full_width = scale * image.shape[-2], scale * image.shape[-1]
    height, width = min(full_height, size[0]), min(full_width, size[1])

    step = 2 * _WHOLE_CELLS
    top = (full_height - height) // step * _WHOLE_CELLS
    left = (full_width - width) // step * _WHOLE_CELLS
    return top, left, height, width


def _crop(image: Tensor, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Tensor:
    """Take the central part of an image."""
    scale = bayer.sites_per_value(image)
    top, left, height, width = _centre(image, size)
    rows = slice(top // scale, (top + height) // scale)
    columns = slice(left // scale, (left + width) // scale)
    return image[..., rows, columns]


def _to_uint8(image: Tensor) -> np.ndarray:
    """Convert floats ``(3, H, W)`` in [0, 1] to uint8 ``(H, W, 3)``."""
    codes = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return np.ascontiguousarray(codes.permute(1, 2, 0).numpy())
