"""``rawaug camera measure``: dark and flat frames in, a sheet out; in Python :meth:`rawaug.Camera.measure`."""

from __future__ import annotations

from dataclasses import replace

import yaml

from rawaug.camera.own import Camera, as_camera
from rawaug.data.pairs import centre
from rawaug.errors import count_of, escape
from rawaug.files import files_in, require_output, write_text
from rawaug.io import RawFrame, read_raw
from rawaug.io.raw import RAW_EXTENSIONS

_SIDE = 1024
"""Side of the middle of a frame that is measured, in pixels."""


def run(*, dark: str, flat: str, out: str, camera: str | None = None, overwrite: bool = False) -> None:
    """Measure gain, read noise and row noise by ISO, and write a camera's sheet.

    Args:
        dark: folder of RAW files with the lens capped, two or more at each ISO.
        flat: folder of RAW files of an even light, two or more at each of several levels, at each ISO.
        out: output .yaml file.
        camera: name of a published camera, or a sheet, whose colours to take; by default the files state them.
        overwrite: replace the output file if it exists.
    """
    require_output(out, overwrite, (".yaml", ".yml"), [dark, flat])
    colours = None if camera is None else as_camera(camera)

    measured = Camera.measure(_read(dark), _read(flat), colours)
    write_text(yaml.safe_dump(measured.to_json(), sort_keys=False), out)
    print(f"{out}: {escape(measured.name)}, {escape(measured.source or '')}")


def _read(folder: str) -> list[RawFrame]:
    """Read the middles of the RAW files of a folder; those that cannot be read are counted and named."""
    frames, broken = [], []
    for file in files_in(folder, "RAW", RAW_EXTENSIONS):
        try:
            frame = read_raw(file)
        except (OSError, ValueError) as error:
            broken.append(str(error))
            continue

        middle = centre(frame.mosaic, _SIDE, _SIDE).clone()  # the rest need not stay in memory
        frames.append(replace(frame, mosaic=middle))

    if broken:
        print(f"{escape(folder)}: {count_of(len(broken), 'file')} left out, {escape('; '.join(broken[:3]))}")
    return frames
