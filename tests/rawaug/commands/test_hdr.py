"""``rawaug hdr``: the picture it writes, exposures from EXIF, and errors of one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from rawaug.cli import main
from rawaug.commands.hdr import exposures, hdr
from rawaug.commands.hdr import run as hdr_command
from rawaug.data.demo import demo_photographs
from rawaug.io import read_picture, write_picture
from rawaug.io.pictures import decode_srgb, encode_srgb
from rawaug.io.shots import read_shot_exposure
from rawaug.io.stored import read_stored


def shot(
    path: Path, level: int | np.ndarray, seconds: float = 0.0, iso: int = 100, size: tuple[int, int] = (8, 12)
) -> str:
    """A JPEG of one grey level, or of pixels ``(H, W, 3)``, with EXIF if it was exposed for ``seconds`` at f/4."""
    pixels = np.broadcast_to(np.asarray(level, np.uint8), (*size, 3)).copy()
    spec = oiio.ImageSpec(size[1], size[0], 3, "uint8")
    spec.attribute("CompressionQuality", 97)
    if seconds:
        spec.attribute("ExposureTime", seconds)
        spec.attribute("FNumber", 4.0)
        spec.attribute("Exif:PhotographicSensitivity", iso)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()
    return str(path)


def test_exif_gives_stops_relative_to_the_median(tmp_path: Path) -> None:
    paths = [
        shot(tmp_path / "long.jpg", 200, 1 / 15),
        shot(tmp_path / "short.jpg", 30, 1 / 240),
        shot(tmp_path / "iso.jpg", 90, 1 / 120, iso=200),
    ]
    assert exposures(paths, None) == pytest.approx([2.0, -2.0, 0.0], abs=1e-3)
    assert read_shot_exposure(paths[0]) == pytest.approx(math.log2(1 / 15 / 16), abs=1e-3)


def test_the_command_writes_the_merged_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dark, bright, out = str(tmp_path / "dark.png"), str(tmp_path / "bright.png"), tmp_path / "new" / "out.png"
    ramp = torch.linspace(0.0, 1.0, 24).expand(3, 8, 24)
    write_picture(dark, ramp * 0.4)
    write_picture(bright, ramp)
    arguments = ["hdr", dark, bright, "--ev", "[-2,0]", "--out", str(out), "--isp", "universal-small"]
    assert main(arguments) == 0
    undetailed, written = capsys.readouterr().out.splitlines()
    assert "too little detail" in undetailed and written == str(out)
    merged = hdr([dark, bright], [-2, 0], isp="universal-small")
    assert (read_picture(out) / 255.0 - merged).abs().max() <= 0.51 / 255
    alone, brighter = (hdr([dark], exposure=stops, isp="universal-small").mean() for stops in (0.0, 1.0))
    assert brighter > 1.2 * alone
    with pytest.raises(ValueError, match="overwrite=True"):
        hdr_command([dark], out=str(out))
    with pytest.raises(ValueError, match="is the input"):
        hdr_command([str(dark)], out=str(dark), overwrite=True)


def test_errors_are_one_line(tmp_path: Path) -> None:
    first, second = shot(tmp_path / "a.jpg", 60, 1 / 60), shot(tmp_path / "b.jpg", 90)
    wide = shot(tmp_path / "wide.jpg", 90, 1 / 15, size=(8, 16))
    for pictures, stops, message in (
        ([first, second], None, r"b\.jpg: does not state its exposure time or f-number or ISO; give .* as ev=$"),
        ([first, wide], None, r"wide\.jpg: is 8 x 16, but .*a\.jpg is 8 x 12; align and crop"),
        ([first, second], [0.0], r"--ev: one exposure for each picture is needed, got 1 for 2$"),
        ([first, second], [0.0, math.inf], r"an exposure must be a number from -30.0 to 30.0, got inf"),
        ([first, second], [1.0, 1.0], r"exposures must differ"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            hdr(pictures, stops, isp="universal-small")
        assert "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"none\.jpg"):
        hdr([str(tmp_path / "none.jpg"), first])
    with pytest.raises(ValueError, match="exposure"):
        hdr([first], exposure=5000.0)


def test_a_handheld_bracket_is_written_in_16_bits_with_exif_and_as_linear_light(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = decode_srgb(demo_photographs("test")["coffee"].float() / 255) * 0.3
    paths, still = [], []
    for name, ev, top in (("short", -2, 6), ("middle", 0, 8), ("long", 2, 11)):
        shown = (encode_srgb((scene * 2.0**ev).clamp(0, 1)) * 255).byte().permute(1, 2, 0).numpy()
        moved = shown[top : top + 256, top : top + 320]
        paths.append(shot(tmp_path / f"{name}.jpg", moved, 2.0**ev / 100, size=(256, 320)))
        still.append(shot(tmp_path / f"still-{name}.jpg", shown[8:264, 8:328], 2.0**ev / 100, size=(256, 320)))

    assert main(["hdr", *paths, "--out", str(tmp_path / "merged.tif")]) == 0
    short, long, _ = capsys.readouterr().out.splitlines()
    distances = [float(line.split("moved by ")[1].split()[0]) for line in (short, long)]
    assert distances == pytest.approx([8**0.5, 18**0.5], abs=0.4)

    stored = read_stored(tmp_path / "merged.tif")
    assert stored.colours.dtype == np.uint16
    assert read_shot_exposure(tmp_path / "merged.tif") == pytest.approx(read_shot_exposure(paths[1]), abs=1e-3)
    tripod = hdr(still, align=False)
    error = (stored.srgb - tripod).square().mean()
    assert error < 0.1 * (hdr(paths, align=False) - tripod).square().mean()

    assert main(["hdr", *paths, "--out", str(tmp_path / "merged.exr"), "--exposure", "3"]) == 0
    light = oiio.ImageBuf(str(tmp_path / "merged.exr")).get_pixels()
    assert light is not None and light.dtype == np.float32 and light.max() > 1.5, "highlights are not clipped"


def test_parts_that_move_by_themselves_are_refused_by_name(tmp_path: Path) -> None:
    scene = demo_photographs("test")["coffee"]
    torn = torch.cat([scene[:, k : k + 50].roll((3 * k) % 17 - 8, dims=2) for k in range(0, 400, 50)], dim=1)
    for name, picture in (("a", scene), ("b", torn)):
        write_picture(tmp_path / f"{name}.png", picture)
    with pytest.raises(ValueError, match=r"b\.png: .* parts moved otherwise .*--align false"):
        hdr([tmp_path / "a.png", tmp_path / "b.png"], [0.0, 0.1], isp="universal-small")
