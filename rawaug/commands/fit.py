"""``rawaug fit``: RAW files in, an ISP file out; in Python :func:`rawaug.fit`, of :mod:`rawaug.training.camera_fit`."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rawaug.commands import OPTIONS
from rawaug.data.pair_folder import MosaicSettings
from rawaug.errors import count_of, escape
from rawaug.files import locked, require_output
from rawaug.isp.fit import FitConfig
from rawaug.noise import MeasuredLevels, camera_law
from rawaug.training.camera_fit import fit
from rawaug.training.noise_fit import noise_figures


def run(
    data: list[str],
    /,
    *,
    camera_jpeg: Annotated[bool, Parameter(negative="--no-camera-jpeg")] = True,
    held_out: str | None = None,
    out: str,
    noise: Literal["auto", "on", "off"] = "auto",
    dark: str | None = None,
    camera: str | None = None,
    overwrite: bool = False,
    mosaics: Annotated[MosaicSettings, OPTIONS] | None = None,
    config: Annotated[FitConfig, OPTIONS] | None = None,
) -> None:
    """Fit a dictionary ISP to RAW files of a camera.

    Args:
        data: RAW files, folders of them, or one kind:path.
        camera_jpeg: use the camera's JPEG of the same stem as the sRGB image, else LibRaw's rendering.
        held_out: frames to leave out of the fit; their PSNR_r is shown during the fit.
        out: output .safetensors file.
        noise: measure the camera's noise at each ISO of the files; auto continues without it if the frames do not allow
            it.
        dark: folder of dark frames to measure the read variance.
        camera: figures of the camera to start from, a YAML file or the name of a published camera.
        overwrite: replace the output file if it exists.
        mosaics: CFA and levels of pairs:PATH.
        config: settings of the fit.
    """
    require_output(out, overwrite, (".safetensors",), data)

    figure = Path(out).with_name(f"{Path(out).stem}-noise.png")
    if not Path(f"{out}.state").exists():  # a fit that goes on may have drawn its figures already
        for existing in figure.parent.glob(f"{glob.escape(figure.stem)}*.png"):
            require_output(existing, overwrite)
    figure.parent.mkdir(parents=True, exist_ok=True)
    with locked(Path(f"{out}.lock")):
        isp = fit(
            data,
            noise_figure=figure,
            state=f"{out}.state",
            camera_jpeg=camera_jpeg,
            held_out=held_out,
            noise=noise,
            dark=dark,
            camera=camera,
            **vars(mosaics or MosaicSettings()),
            **vars(config or FitConfig()),
        )
        isp.info["data"] = data
        isp.save(out)

    for line in isp.info.get("unreadable", []):
        print(escape(line))
    print(f"{out}: fitted to {count_of(len(isp.info['frames']), 'frame')} in {isp.info['seconds']} s")
    scores = isp.info.get("held_out", [])
    if scores:
        blind, as_shot = scores[-1]["blind"], scores[-1]["as_shot"]
        print(f"PSNR of the held-out frames: {blind:.2f} dB blind, {as_shot:.2f} dB with the as-shot white balance")
    if "noise_not_measured" in isp.info:
        print(f"The noise was not measured: {isp.info['noise_not_measured']}")
    if "noise" in isp.info:
        _print_noise(camera_law(isp.info["noise"]), figure)


def _print_noise(law: MeasuredLevels, figure: Path) -> None:
    for level in law.levels:
        condition = "" if level.iso is None else f" at ISO {level.iso:g}"
        print(f"Noise{condition}: shot_var {level.shot_var:.3g}, read_var {level.read_var:.3g}, R^2 {level.r2:.3f}")

    figures = ", ".join(map(str, noise_figures(figure, law)))
    print(f"Measured points and fitted lines: {figures}")
