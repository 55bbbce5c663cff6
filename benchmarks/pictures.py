"""Pictures and RAW files of anybody's folder, read here and by others: what is equal, what differs, what is refused.

    python -m benchmarks.pictures FOLDER [FOLDER ...] [--json FILE] [--tolerance 3]

Pictures are read beside Pillow, which turns them upright, applies their ICC profile and composites them over black.
DNGs are read beside tifffile's decoding of their mosaic, within the active area, cut at white. Every file of the
folders is opened, whatever its name. Printed are the counts, then a line for each file that differs (the mean and the
largest difference in units of 1/255, or in digital numbers, and what is known of the reason) or is refused.
Equal means that no number differs by more than the tolerance: decoders of JPEG, and profiles, round differently.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageCms, ImageOps

from benchmarks.measure import parser
from rawaug.bayer import plane_indices
from rawaug.io import RawFrame, read_picture, read_raw
from rawaug.io.content import Content, identify_content
from rawaug.io.isolated import isolated
from rawaug.io.tiff import ACTIVE_AREA, all_pages, main_mosaic, opened_tiff

TOLERANCE = 3.0


class Comparison(NamedTuple):
    """What came of one file: its outcome, its format, and a line that says why."""

    path: Path
    outcome: str
    format: str
    reason: str = ""


def compare(path: Path, tolerance: float = TOLERANCE) -> Comparison:
    """Read a file here and by the other library."""
    try:
        content = identify_content(path)
    except OSError as error:
        return Comparison(path, "not opened", "unknown", str(error))
    if content.kind == "other":
        return Comparison(path, "neither picture nor RAW", content.format)
    if content.kind == "raw":
        return _compare_raw(path, content)
    return _compare_picture(path, content, tolerance)


# -- pictures ----------------------------------------------------------------------------------------------------------


def _compare_picture(path: Path, content: Content, tolerance: float) -> Comparison:
    ours, refusal = _attempt(read_picture, path)
    theirs, notes = _attempt(read_with_pillow, path)
    name = content.format
    if ours is None and theirs is None:
        return Comparison(path, "refused by both", name, refusal)
    if ours is None:
        return Comparison(path, "refused here", name, refusal)
    if theirs is None:
        return Comparison(path, "refused by Pillow", name, notes)

    pixels, reason = theirs
    read = ours.permute(1, 2, 0).numpy().astype(np.float64)
    if read.shape != pixels.shape:
        return Comparison(path, "different", name, f"{read.shape} here, {pixels.shape} there")
    difference = np.abs(read - pixels)
    if difference.max() <= tolerance:
        return Comparison(path, "equal", name)
    figures = f"mean {difference.mean():.2f}, largest {difference.max():.0f}"
    return Comparison(path, "different", name, f"{figures}; {reason or 'reason unknown'}")


def _attempt(read: Any, path: Path) -> tuple[Any, str]:
    """What a reader gives, isolated; None and its error where it fails."""
    try:
        return isolated(read, path), ""
    except Exception as error:  # Pillow raises many kinds
        return None, " ".join(str(error).split()) or type(error).__name__


def read_with_pillow(path: Path) -> tuple[np.ndarray, str]:
    """A picture as sRGB ``(H, W, 3)`` in units of 1/255, and what Pillow is known to do otherwise with such a file."""
    with warnings.catch_warnings(), Image.open(path) as image:
        warnings.simplefilter("ignore")
        reason = _known_reason(image)
        profile = image.info.get("icc_profile")
        upright = ImageOps.exif_transpose(image)
        if upright.mode.startswith("I;16") or upright.mode == "I":
            return np.repeat(np.asarray(upright, np.float64)[..., None] / 257, 3, axis=-1), reason
        if upright.mode == "F":
            return np.repeat(np.asarray(upright, np.float64)[..., None] * 255, 3, axis=-1), reason
        flat = _over_black(upright)
        return np.asarray(_as_srgb(flat, profile), np.float64), reason


def _known_reason(image: Any) -> str:
    if getattr(image, "n_frames", 1) > 1:
        return "Pillow reads the first of several pictures"
    if image.mode in ("CMYK", "YCbCr", "LAB"):
        return f"stored as {image.mode}"
    if image.info.get("icc_profile"):
        return "Pillow applies the profile in 8 bits"
    if image.info.get("gamma"):
        return "a gamma is stated, which Pillow does not apply"
    if "transparency" in image.info or image.mode in ("RGBA", "LA", "PA"):
        return "alpha"
    return ""


def _over_black(image: Any) -> Any:
    if "transparency" not in image.info and image.mode not in ("RGBA", "LA", "PA", "RGBa", "La"):
        return image.convert("RGB")
    picture = image.convert("RGBA")
    black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
    return Image.alpha_composite(black, picture).convert("RGB")


def _as_srgb(image: Any, profile: bytes | None) -> Any:
    if not profile:
        return image
    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    if source.profile.xcolor_space.strip() != "RGB":
        return image
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), intent, flags=flags)


# -- RAW ---------------------------------------------------------------------------------------------------------------


def _compare_raw(path: Path, content: Content) -> Comparison:
    frame, refusal = _attempt(read_raw, path)
    numbers, notes = _attempt(mosaic_of_tifffile, path)
    if frame is None:
        outcome = "refused by both" if numbers is None else "refused here"
        return Comparison(path, outcome, content.format, refusal)
    if numbers is None:
        return Comparison(path, "not decoded by tifffile", content.format, notes)

    read = digital_numbers(frame)
    height, width = read.shape
    if abs(numbers.shape[0] - height) > 1 or abs(numbers.shape[1] - width) > 1:
        return Comparison(path, "different", content.format, f"{read.shape} here, {numbers.shape} there")
    expected = np.minimum(numbers[:height, :width], frame.white)
    difference = np.abs(read - expected)
    if difference.max() <= 0.5:
        return Comparison(path, "equal", content.format)
    figures = f"mean {difference.mean():.2f}, largest {difference.max():.1f} of white {frame.white:g}"
    return Comparison(path, "different", content.format, f"{figures}; its levels may be of rows or of a larger cell")


def mosaic_of_tifffile(path: Path) -> np.ndarray:
    """The numbers of a DNG's mosaic within its active area, float64 ``(H, W)``."""
    with opened_tiff(path) as tiff:
        page = main_mosaic(all_pages(tiff))
        if page is None:
            raise ValueError(f"{path}: has no mosaic that TIFF's tags describe")
        numbers = page.asarray().astype(np.float64)
        area = page.tags.valueof(ACTIVE_AREA) or (0, 0, *numbers.shape)
    top, left, bottom, right = area
    return numbers[top:bottom, left:right]


def digital_numbers(frame: RawFrame) -> np.ndarray:
    """The numbers that a frame was read from, cut at white, float64 ``(H, W)``."""
    kinds = plane_indices(frame.cfa).numpy()
    height, width = frame.mosaic.shape[-2:]
    repeats = -(-height // kinds.shape[0]), -(-width // kinds.shape[1])
    black = np.array(frame.black)[np.tile(kinds, repeats)[:height, :width]]
    return frame.mosaic[0].double().numpy() * (frame.white - black) + black


# -- folders -----------------------------------------------------------------------------------------------------------


def frame_files(folders: Sequence[str]) -> Iterator[Path]:
    """Every file below the folders, sorted."""
    for folder in folders:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file():
                yield path


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("folders", nargs="+")
    options.add_argument("--tolerance", type=float, default=TOLERANCE, help="in units of 1/255")
    options.add_argument("--json", type=Path, help="write all outcomes to this file")
    args = options.parse_args(arguments)

    comparisons = [compare(path, args.tolerance) for path in frame_files(args.folders)]
    counts = Counter(one.outcome for one in comparisons)
    print(f"{len(comparisons)} files")
    for outcome, count in counts.most_common():
        formats = Counter(one.format for one in comparisons if one.outcome == outcome)
        print(f"  {outcome}: {count} ({', '.join(f'{name} {n}' for name, n in formats.most_common())})")
    for one in comparisons:
        if one.outcome not in ("equal", "neither picture nor RAW"):
            print(f"{one.outcome}: {one.path}: {one.reason}")
    if args.json:
        rows = [one._asdict() | {"path": str(one.path)} for one in comparisons]
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
