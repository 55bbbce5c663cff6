"""Screenshots, dithered pictures and halftones keep their pixels; noisy photographs, however dark, do not."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional as F

from rawaug.data.demo import demo_photographs
from rawaug.denoising.denoiser import Noisy
from rawaug.denoising.drawn import explain_drawn
from rawaug.denoising.pictures import PictureDenoiser, PictureFiles
from rawaug.plugin.jpeg import compress_jpeg


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    """A middle of 256 x 256 of a demo photograph, uint8 ``(3, 256, 256)``."""
    picture = next(iter(demo_photographs("test").values()))
    return picture[:, :256, :256]


def as_image(picture: Tensor) -> Image.Image:
    return Image.fromarray(picture.permute(1, 2, 0).numpy())


def as_tensor(image: Image.Image) -> Tensor:
    return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1)[None] / 255.0


def screenshot() -> Image.Image:
    image = Image.new("RGB", (256, 256), (250, 250, 252))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, 256, 30), fill=(36, 41, 46))
    for line in range(14):
        draw.text((8, 40 + 15 * line), f"{line}: the quick brown fox jumps over", fill=(20 * line, 20, 120))
    # a gradient gives it more colours than a palette has
    for column in range(256):
        for row in range(4):
            draw.point((column, 26 + row), fill=(column, 255 - column, 60 * row))
    return image


def halftone(photograph: Tensor) -> Tensor:
    """Dots of 6 pixels, softened as a scanner does."""
    y, x = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    screen = (2.0 + torch.cos((x + y) * torch.pi / 4.2) + torch.cos((x - y) * torch.pi / 4.2)) / 4.0
    dots = (photograph.float().mean(0) / 255.0 > screen).float()[None, None]
    return F.avg_pool2d(F.pad(dots, (1, 1, 1, 1), mode="replicate"), 3, 1).expand(1, 3, 256, 256)


def test_each_kind_of_drawn_picture_is_recognised(photograph: Tensor) -> None:
    dithered = as_image(photograph).quantize(16, dither=Image.Dither.FLOYDSTEINBERG)
    web = as_tensor(as_image(photograph).convert("P"))
    cases = {
        "palette": [as_tensor(dithered), as_tensor(as_image(photograph).convert("1"))],
        "screenshot": [as_tensor(screenshot())],
        "dithered": [compress_jpeg(web, torch.tensor([90]))],
        "halftone": [compress_jpeg(halftone(photograph).contiguous(), torch.tensor([90]))],
    }
    for word, pictures in cases.items():
        for picture in pictures:
            assert word in str(explain_drawn(picture))


@pytest.mark.parametrize("deviation", [1.0, 5.0, 25.0, 75.0])
def test_a_noisy_photograph_is_not_drawn(photograph: Tensor, deviation: float) -> None:
    generator = torch.Generator().manual_seed(0)
    noise = deviation / 255.0 * torch.randn(1, 3, 256, 256, generator=generator)
    for light in (1.0, 0.1):
        noisy = (255.0 * (light * photograph[None] / 255.0 + noise).clamp(0.0, 1.0)).round() / 255.0
        assert explain_drawn(noisy) is None
        if deviation > 1.0:
            assert explain_drawn(compress_jpeg(noisy, torch.tensor([85]))) is None


def test_a_noisy_photograph_within_black_borders_is_not_drawn(photograph: Tensor) -> None:
    noisy = photograph[None] / 255.0 + 0.05 * torch.randn(1, 3, 256, 256, generator=torch.Generator().manual_seed(0))
    assert explain_drawn(F.pad(noisy.clamp(0.0, 1.0), (200, 200, 0, 0))) is None


def test_a_drawn_file_keeps_its_bytes_and_the_line_says_why(tmp_path: Path) -> None:
    content = BytesIO()
    screenshot().save(content, "JPEG", quality=95)
    (tmp_path / "in.jpg").write_bytes(content.getvalue())

    _, report = PictureFiles("rawaug-srgb").denoise(tmp_path / "in.jpg", tmp_path / "out.jpg")
    assert (tmp_path / "out.jpg").read_bytes() == content.getvalue()
    assert "screenshot" in str(report)
    assert report.deviation == 0.0


def test_a_picture_is_judged_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []

    def judge(srgb: torch.Tensor) -> None:
        judged.append(srgb)

    monkeypatch.setattr("rawaug.denoising.pictures.explain_drawn", judge)
    screenshot().save(tmp_path / "in.png")
    PictureFiles("NonLocalMeans").denoise(tmp_path / "in.png", tmp_path / "out.png")
    assert len(judged) == 1


def test_a_level_that_is_told_denoises_a_drawn_picture_too() -> None:
    picture = as_tensor(screenshot())
    assert torch.equal(PictureDenoiser.of("NonLocalMeans")(Noisy(picture)), picture)
    assert not torch.equal(PictureDenoiser.of("NonLocalMeans@10")(Noisy(picture)), picture)
