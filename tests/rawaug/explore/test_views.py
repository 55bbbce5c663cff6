"""The views of the page without a page: pictures of settings, and code that makes the same pair."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rawaug.cli import main
from rawaug.data import demo_pictures
from rawaug.explore import views
from rawaug.explore.figures import variance_by_signal
from rawaug.explore.page import as_html, message
from rawaug.explore.views import Look, command, drop_inapplicable, iso_range, make_example, noise_choices, python
from rawaug.io import read_picture, write_picture
from rawaug.plugin.config import AugmentConfig
from rawaug.plugin.draw import Draw
from rawaug.plugin.targets import Srgb

LEVELS = (1e-4, 1e-6)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A photograph of 97 x 145, in a folder whose name needs quoting."""
    file = tmp_path_factory.mktemp("my pictures") / "cat's.png"
    write_picture(file, demo_pictures(1)[0][:, 100:197, 120:265])
    return str(file)


@pytest.mark.parametrize(
    "config",
    [
        AugmentConfig(
            camera="Nikon D750",
            noise="Nikon D750",
            iso=1600.0,
            draw=Draw(exposure=-0.5, light=4000.0, tone="Nikon D750"),
            cfa="GRBG",
        ),
        AugmentConfig(noise=LEVELS, draw=Draw(light="LED-B3"), cfa="XTRANS"),
        AugmentConfig("canon-powershot", noise="any camera", draw=Draw(exposure=0.25)),
        AugmentConfig(target="srgb"),
        AugmentConfig(target=Srgb(finish=True)),
        AugmentConfig(burst=3),
    ],
)
def test_command_and_python_make_the_pair_bit_for_bit(picture: str, config: AugmentConfig, tmp_path: Path) -> None:
    look = Look(picture, config, seed=5)
    pair = make_example(look).pair
    words = shlex.split(command(look, str(tmp_path)))
    assert words[0] == "rawaug" and main([*words[1:], "--workers", "0"]) == 0
    with np.load(tmp_path / "cat's_0.npz") as file:
        assert np.array_equal(file["noisy"], pair.noisy.numpy()) and np.array_equal(file["clean"], pair.clean.numpy())
    made: dict[str, Any] = {}
    exec(python(look), made)
    assert torch.equal(made["pair"].noisy, pair.noisy) and torch.equal(made["pair"].clean, pair.clean)


def test_developed_without_noise_it_is_the_picture_again(picture: str) -> None:
    for isp, most in (("universal", 2), ("gopro-hero", 6)):  # of a learned tone network the curve of greys alone
        look = Look(picture, AugmentConfig(isp, noise=(1e-12, 1e-12), draw=Draw(exposure=0.0)))
        noisy, clean = views.pair(look)
        truth = read_picture(picture)[:, :96, :144].permute(1, 2, 0).numpy().astype(float)
        for panel in (noisy, clean):
            assert panel.image.shape == truth.shape
            error = np.abs(panel.image.astype(float) - truth)
            assert np.median(error) <= most, f"{isp}: {panel.title}"  # edges are those of bilinear demosaicing


def test_every_view_has_titled_pictures_and_the_draws_differ(picture: str) -> None:
    look = Look(picture, AugmentConfig(noise=LEVELS))
    panels = {name: view(views.with_tab(name, look)) for name, view in views.VIEWS.items()}
    assert {name: len(found) for name, found in panels.items()} == {
        "Pair": 2, "Stages": 5, "RAW": 6, "Camera": 2, "Noise": 1, "Eight draws": 8, "sRGB": 3, "Burst": 4
    }  # fmt: skip
    for panel in (panel for found in panels.values() for panel in found):
        assert panel.title and panel.image.dtype == np.uint8 and panel.image.shape[2] == 3 and panel.image.std() > 3
    first, second = (panel.image.astype(float) for panel in panels["Burst"][:2])
    assert panels["Burst"][0].title.startswith("frame 0: +0.0 pixels down") and np.abs(first - second).mean() > 1
    means = {tuple(panel.image.mean(axis=(0, 1)).round(1)) for panel in panels["Eight draws"]}
    assert len(means) == 8, "eight cameras in eight lights"
    fixed = replace(look.config, camera="Nikon D750", draw=Draw(exposure=0.0, light=5500.0, tone="linear"))
    same = np.stack([panel.image.mean(axis=(0, 1)) for panel in views.draws(replace(look, config=fixed))])
    assert same.std(axis=0).max() < 5, "what is fixed does not vary"


def test_other_patterns_have_no_packed_planes_and_no_network(picture: str) -> None:
    look = Look(picture, AugmentConfig(cfa="XTRANS"))
    assert [panel.title.partition(":")[0] for panel in views.raw(look)] == ["XTRANS", "histograms"]
    assert views.pair(look)[0].image.shape == (96, 144, 3)
    with pytest.raises(ValueError, match="Bayer"):
        views.denoise(look)


def test_the_shipped_network_removes_noise(picture: str) -> None:
    look = Look(picture, AugmentConfig(noise=(5e-3, 1e-4), draw=Draw(exposure=0.0, light=5500.0), cfa="BGGR"))
    noisy, denoised = views.denoise(look)
    before, after = (float(panel.title.split()[-2]) for panel in (noisy, denoised))
    assert after > before + 3
    clean = views.pair(look)[1].image.astype(float)
    assert np.square(denoised.image - clean).mean() < np.square(noisy.image - clean).mean() / 2


def test_large_pictures_are_shown_in_part(tmp_path: Path) -> None:
    write_picture(tmp_path / "large.png", demo_pictures(1)[0].repeat(1, 2, 2))
    look = Look(str(tmp_path / "large.png"), AugmentConfig())
    assert make_example(look).srgb.shape == (3, 1024, 1024)
    assert [panel.image.shape for panel in views.pair(look)] == [(512, 768, 3)] * 2
    assert {max(panel.image.shape) for panel in views.stages(look)} == {512}
    whole, part = make_example(look).pair.clean, views._crop(make_example(look).pair.clean)
    assert part.shape == (4, 256, 384) and torch.equal(part, whole[:, 126:382, 60:444])


def test_measured_variance_follows_the_law() -> None:
    generator = torch.Generator().manual_seed(0)
    clean = torch.rand(400_000, generator=generator)
    law = 1e-3 * clean + 1e-5
    noisy = (clean + torch.randn(clean.shape, generator=generator) * law.sqrt()).clamp(max=1.0)
    signal, variance = variance_by_signal(clean, noisy, law)
    assert len(signal) > 8
    torch.testing.assert_close(variance, 1e-3 * signal + 1e-5, rtol=0.2, atol=0)


def test_what_does_not_apply_is_left_out() -> None:
    fitted = AugmentConfig("gopro-hero", "Nikon D750", draw=Draw(light=5500.0, tone="linear"))
    assert drop_inapplicable(fitted) == AugmentConfig("gopro-hero")
    preset = AugmentConfig("universal-small", noise="upi", iso=800.0, draw=Draw(tone="nokia like"))
    assert drop_inapplicable(preset) == AugmentConfig("universal-small", noise="upi")
    kept = AugmentConfig(noise="Nikon D750", iso=800.0, draw=Draw(tone="linear"))
    assert drop_inapplicable(kept) == kept
    assert "camera" in noise_choices("gopro-hero") and "camera" not in noise_choices("universal")
    assert iso_range("any camera") is not None and iso_range("camera") is None


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    look = Look(str(tmp_path / "a.png"))
    means = []
    for value in (50, 200):
        write_picture(look.picture, torch.full((3, 16, 16), value, dtype=torch.uint8))
        means.append(make_example(look).pair.clean.mean())
    assert means[0] < means[1]


def test_titles_and_messages_are_text_and_pictures_are_data() -> None:
    page = as_html([views.Panel("<b>&", np.full((4, 4, 3), 7, np.uint8))])
    assert "&lt;b&gt;&amp;" in page and "<b>" not in page and 'src="data:image/jpeg;base64,/9j/' in page
    assert "&lt;x" in message("<x.png: no picture")
