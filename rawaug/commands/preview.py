"""``rawaug preview``: the stages of an ISP on a picture, augmented RAWs of it, and the atoms of the dictionaries.

Linear images are shown through the sRGB curve, RAW bilinearly demosaiced and without white balance: greenish, as a
sensor sees. The drawn RAWs are clean, and all developed alike, by the ISP's forward pass under the setting that it
chooses for the picture: what differs between them is camera, light, tone and exposure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import pattern
from rawaug.errors import extra
from rawaug.explore.views import stage_pictures
from rawaug.files import require_writable
from rawaug.io import encode_srgb, read_picture
from rawaug.io.pictures import MAX_PIXELS
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading, frame_coordinates
from rawaug.isp.tone import STEPS
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.pictures import trim_to_even
from rawaug.seeding import keyed_generator

_MAXIMUM = 768
"""Largest side of a previewed picture: larger ones are cropped at the centre."""


def run(
    picture: str,
    /,
    *,
    out: str,
    isp: str = "universal",
    count: int = 8,
    seed: int = 0,
    cfa: str | None = None,
    max_pixels: int = MAX_PIXELS,
) -> None:
    """Draw a picture at every stage of an ISP, and as augmented RAW.

    Args:
        picture: an sRGB picture.
        out: output PNG; the atoms are written to NAME-atoms.png.
        isp: ISP file, or the name of a shipped ISP.
        count: number of augmented RAWs to plot.
        seed: random seed of the augmented RAWs.
        cfa: pattern of the RAW: RGGB, BGGR, GRBG, GBRG, XTRANS, or QUAD-RGGB and the like; the ISP's by default.
        max_pixels: a larger picture is refused before it is decoded.
    """
    if count < 0:
        raise ValueError(f"count must be at least 0, got {count}")
    stages = Path(out) if Path(out).suffix else Path(f"{out}.png")
    require_writable(stages)
    augment = RawAugment.from_pretrained(isp, cfa=cfa)
    whole = trim_to_even(read_picture(picture, max_pixels))
    stages.parent.mkdir(parents=True, exist_ok=True)
    atoms = stages.with_name(f"{stages.stem}-atoms{stages.suffix}")
    _draw_stages(augment, whole, count, seed).savefig(stages, dpi=130)
    _draw_atoms(augment.isp).savefig(atoms, dpi=130)
    print(f"{stages}\n{atoms}")


@torch.no_grad()
def _draw_stages(augment: RawAugment, whole: Tensor, count: int, seed: int) -> Any:
    with extra("train"):
        from matplotlib.figure import Figure

    isp, sensor, frame = augment.isp, pattern(augment.cfa), (whole.shape[-2], whole.shape[-1])
    height, width = (min(side, _MAXIMUM) for side in frame)
    top, left = (frame[0] - height) // 4 * 2, (frame[1] - width) // 4 * 2
    srgb = bayer.crop(whole, top, left, height, width)
    place = frame_coordinates(height, width, (top, left), frame)
    setting = isp.reverse(srgb[None], coordinates=place).params
    panels = stage_pictures(augment, srgb, setting, place)
    generator = keyed_generator(seed, "preview")
    for k in range(count):
        params = augment.sample(srgb[None], generator, torch.tensor([[top, left, *frame, 0]]))
        pair = augment.apply(srgb[None], params)
        gains = " ".join(f"{gain:.2f}" for gain in pair.params.isp.gains[0].tolist())
        developed = isp.forward_pixels(sensor.demosaic(augment.mosaic(pair.clean)), setting).clamp(0, 1)
        panels[f"draw {k + 1}: gains {gains}\nmean {pair.clean.mean().item():.3f}"] = developed[0]
    columns = max(len(panels) - count, 4)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for axis in axes:
        axis.set_axis_off()
    for axis, (title, image) in zip(axes, panels.items(), strict=False):
        axis.imshow(image.permute(1, 2, 0).numpy())
        axis.set_title(title, fontsize=9)
    return figure


@torch.no_grad()
def _draw_atoms(isp: DictionaryISP) -> Any:
    with extra("train"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.6), layout="constrained")
    colour, gains, shading, tone = figure.subplots(1, 4, width_ratios=[3, 2, 1.5, 2])
    _swatches(colour, isp)
    _gain_swatches(gains, isp)
    lens = isp.find(LensShading)
    mask = lens.mask(frame_coordinates(75, 100))[0, 0] if lens else torch.ones(75, 100)
    image = shading.imshow(mask.numpy(), vmin=0, vmax=1, cmap="gray")
    figure.colorbar(image, ax=shading, shrink=0.6)
    shading.set_title("lens shading mask" if mask.min() < 1 else "lens shading: none", fontsize=9)
    shading.set(xticks=[], yticks=[])
    _tone_curves(tone, isp)
    return figure


def _tone_curves(axis: Any, isp: DictionaryISP) -> None:
    """What grey becomes: every tone atom in grey, the learned or typical curve in colour."""
    grey = torch.linspace(0, 1, 256)
    if isp.tone is not None:
        axis.plot(grey.numpy(), isp.tone.curves[:, ::STEPS].T.numpy(), color="0.75", linewidth=0.8)
    for line, name in zip(isp.linear(grey.expand(1, 3, 1, 256))[0, :, 0], ("red", "green", "blue"), strict=True):
        axis.plot(grey.numpy(), line.numpy(), color=f"tab:{name}")
    axis.set(xlabel="sRGB grey", ylabel="x2", aspect="equal")
    typical = f"{isp.config.tone_atoms} tone atoms, the typical one"
    axis.set_title("inverse tone curve and gamma" if isp.tone is None else typical, fontsize=9)


def _swatches(axis: Any, isp: DictionaryISP) -> None:
    """One row per atom: the result for sRGB red, green, blue, white, skin and sky."""
    tones = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0.6, 0.35, 0.25], [0.25, 0.45, 0.65]])
    patches = torch.einsum("nij,kj->nki", isp.colour.atoms(), tones.float())
    axis.imshow(encode_srgb(patches.clamp(0, 1)).numpy(), aspect="auto")
    axis.set_xticks(range(6), ["red", "green", "blue", "white", "skin", "sky"], fontsize=8)
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set(ylabel="atom")
    axis.set_title("colour atoms: sRGB as the camera sees it", fontsize=9)


def _gain_swatches(axis: Any, isp: DictionaryISP) -> None:
    """One row an atom, in the colour of its light: white as it comes back, with the three gains and the weight."""
    atoms, channels = isp.gain.atoms(), isp.gain.channel_gains()
    light = channels.amin(1, keepdim=True) / channels
    axis.imshow(encode_srgb(light)[:, None].numpy(), aspect="auto", extent=(0, 1, len(atoms) - 0.5, -0.5))
    weight = isp.reverse_encoders.gain.prior.softmax(0)
    for row, ((digital, red, blue), share) in enumerate(zip(atoms.tolist(), weight.tolist(), strict=True)):
        text = f"{digital:.2f}   {red:.2f}   {blue:.2f}   {share:.0%}"
        axis.text(0.5, row, text, ha="center", va="center", fontsize=min(8, 120 / len(atoms)), color="black")
    axis.set(ylabel="atom", xticks=[])
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set_title("gain atoms: digital, red, blue, constant weight", fontsize=9)
