"""``rawaug defects``: a map of a sensor's hot and dead pixels; in Python :func:`rawaug.find_defects`."""

from __future__ import annotations

from typing import Annotated

from rawaug.commands import YAML
from rawaug.denoising.defects import find_defects, write_defects
from rawaug.errors import count_of
from rawaug.files import require_output


def run(
    files: list[str],
    /,
    *,
    out: str,
    noise: Annotated[tuple[float, float] | str, YAML] = "auto",
    overwrite: bool = False,
) -> None:
    """Map a sensor's hot and dead pixels, by RAW files of different scenes.

    Args:
        files: two RAW files or more of one camera. A site that stands out in all of them is a defect.
        out: the map, for rawaug denoise --defects: a .badpixels or .txt file of dcraw, with a column and a row a line.
        noise: where the levels of the noise come from, as for rawaug denoise: auto, profile, estimate, a camera, or
            [shot_var, read_var].
        overwrite: replace an existing map.
    """
    require_output(out, overwrite, (".badpixels", ".txt"), files)
    mask = find_defects(files, noise)
    write_defects(mask, out)
    print(f"{out}: {count_of(int(mask.sum()), 'defect')} in {count_of(len(files), 'frame')}")
