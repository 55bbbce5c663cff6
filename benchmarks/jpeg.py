"""JPEG as a transform against libjpeg's codes, by quality and subsampling, beside kornia's differentiable one.

    python -m benchmarks.jpeg

Pictures are four photographs of 256 x 256, noise and stripes of a pixel; kornia has 4:2:0 alone, and no roundings.
"""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.augment import pictures
from rawaug.io.pictures import recode_jpeg
from rawaug.plugin.jpeg import transform_jpeg

QUALITIES = (10, 30, 50, 75, 90, 95, 99, 100)


def shares(ours: Tensor, expected: Tensor) -> str:
    """Share of equal codes, of codes within one, and the largest difference."""
    error = (ours.double() - expected.double()).abs()
    equal, near = (error == 0).double().mean(), (error <= 1).double().mean()
    return f"{100 * equal:.3f} % equal, {100 * near:.3f} % within one, largest {error.max():.0f}"


def main() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = torch.randint(256, (1, 3, 256, 256), generator=generator, dtype=torch.uint8)
    stripes = torch.zeros(1, 3, 256, 256, dtype=torch.uint8)
    stripes[:, 0, :, ::2], stripes[:, 1, ::2] = 204, 102
    codes = torch.cat([pictures(4, 256, 256), noise, stripes])

    for subsampling in ("4:4:4", "4:2:2", "4:2:0"):
        for quality in QUALITIES:
            expected = torch.stack([recode_jpeg(picture, quality, subsampling) for picture in codes])
            drawn = torch.full((len(codes),), quality)
            print(subsampling, quality, shares(transform_jpeg(codes.float(), drawn, [subsampling] * 6), expected))
            if subsampling == "4:2:0":
                print("  kornia, photographs:", shares(by_kornia(codes[:4], quality), expected[:4]))


def by_kornia(codes: Tensor, quality: int) -> Tensor:
    from kornia.enhance import jpeg_codec_differentiable

    coded: Tensor = jpeg_codec_differentiable(codes / 255.0, torch.full((len(codes),), float(quality)))
    return (coded * 255).round()


if __name__ == "__main__":
    main()
