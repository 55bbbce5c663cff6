"""Pictures: files through a denoiser, the level that it is told, and pairs of real pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file as save_weights
from torch import Tensor

import denoisers
import rawaug
from denoisers.ffdnet import Refilled
from rawaug import bayer
from rawaug.cli import main
from rawaug.commands.benchmark import run as benchmark
from rawaug.commands.denoise import run as denoise
from rawaug.data.picture_pairs import open_picture_pairs
from rawaug.denoising.denoise import files_for
from rawaug.denoising.denoiser import Noisy, RawDenoiser, shipped_of_mosaics
from rawaug.denoising.folder import denoise_folder
from rawaug.denoising.picture_levels import estimate_level
from rawaug.denoising.pictures import PictureDenoiser, PictureFiles
from rawaug.evaluation.picture_trials import PUBLISHED, REGISTERED, picture_scores, register
from rawaug.io.pictures import read_picture, write_picture
from rawaug.plugin.finishing import gaussian_blur

pytest.importorskip("OpenImageIO")


def smooth(height: int = 96, width: int = 128) -> Tensor:
    """A soft picture ``(3, height, width)``."""
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 5, width), indexing="ij")
    return torch.stack([0.5 + 0.3 * torch.sin(x + k) * torch.cos(y - k) for k in range(3)])


def noisy(deviation: float = 0.04) -> Tensor:
    return (smooth() + deviation * torch.randn(3, 96, 128, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


def error(picture: Tensor) -> float:
    return (picture - smooth()).square().mean().item()


def test_the_shipped_denoiser_of_pictures_removes_noise() -> None:
    denoised = PictureDenoiser.of("rawaug-srgb")(Noisy(noisy()[None]))[0]
    assert error(denoised) < 0.5 * error(noisy())
    assert "rawaug-srgb" not in shipped_of_mosaics()
    with pytest.raises(ValueError, match="denoises developed pictures"):
        RawDenoiser.of("rawaug-srgb")
    with pytest.raises(ValueError, match="RAW"):
        PictureDenoiser.of("rawaug-small")


def test_a_level_that_is_told_and_the_strength_say_how_much_is_removed() -> None:
    def removed(spec: str, strength: float = 1.0) -> float:
        return (PictureDenoiser.of(spec, strength=strength)(Noisy(noisy()[None]))[0] - noisy()).square().mean().item()

    assert removed("rawaug-srgb@2") < removed("rawaug-srgb@10") < removed("rawaug-srgb@30")
    assert removed("rawaug-srgb", 0.0) == 0.0 < removed("rawaug-srgb", 0.3) < removed("rawaug-srgb", 1.0)
    with pytest.raises(ValueError, match="level after @"):
        PictureDenoiser.of("rawaug-srgb@x")


def test_the_estimated_level_grows_with_the_noise() -> None:
    network = denoisers.from_pretrained("rawaug-srgb")
    weak = estimate_level(network, noisy(0.01)[None])[0]
    strong = estimate_level(network, noisy(0.05)[None])[0]
    assert 0.01 < strong < 0.2
    assert weak < 0.6 * strong


def test_a_clean_picture_is_left_alone() -> None:
    denoiser, clean = PictureDenoiser.of("rawaug-srgb"), smooth()[None]
    assert (denoiser(Noisy(clean)) - clean).square().mean().sqrt() < 0.5 / 255


def test_even_noise_is_removed_and_texture_in_places_is_kept() -> None:
    network = denoisers.from_pretrained("rawaug-srgb")
    grain = 0.02 * torch.randn(1, 3, 256, 256, generator=torch.Generator().manual_seed(0))
    strength = torch.linspace(0.0, 3.0, 8).repeat_interleave(32)

    _, even = estimate_level(network, 0.5 + grain)
    _, uneven = estimate_level(network, 0.5 + grain * strength * strength[:, None] / 3.0)

    assert even > 0.8
    assert uneven < 0.3


class _RemovesAll:
    """A network that removes all noise from a grey picture."""

    light = True

    def __call__(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return torch.full_like(noisy, 0.5)


def test_grain_that_reaches_beyond_neighbours_asks_for_a_higher_level() -> None:
    generator = torch.Generator().manual_seed(0)
    white, other = torch.randn(2, 1, 3, 256, 256, generator=generator)
    of_neighbours = gaussian_blur(white, torch.tensor([0.6]))
    wide = gaussian_blur(other, torch.tensor([3.0]))
    reaching_far = white + wide / wide.std()
    removes_all = _RemovesAll()

    levels = []
    for noise in (of_neighbours, reaching_far):
        levels.append(estimate_level(removes_all, 0.5 + 0.02 * noise / noise.std())[0])
    assert levels[1] > 1.5 * levels[0]


@pytest.mark.parametrize("deviation", [5.0, 20.0, 60.0])
def test_the_level_of_white_and_of_strong_noise_is_what_is_removed(deviation: float) -> None:
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(1, 3, 256, 256, generator=generator)
    coarse = gaussian_blur(white, torch.tensor([1.5]))

    level, _ = estimate_level(_RemovesAll(), 0.5 + deviation / 255.0 * white)
    assert 1.0 <= 255.0 * level / deviation <= 1.25
    if deviation > 10.0:
        level, _ = estimate_level(_RemovesAll(), 0.5 + deviation / 255.0 * coarse / coarse.std())
        assert 1.0 <= 255.0 * level / deviation <= 1.7


def test_a_self_ensemble_denoises_a_turned_picture_to_the_turned_result() -> None:
    denoiser = PictureDenoiser.of("rawaug-srgb@10", views=8)
    upright, turned = (denoiser(Noisy(bayer.turn(noisy()[None], view))) for view in (0, 5))
    assert torch.allclose(bayer.turn(upright, 5), turned, atol=1e-4)
    two = PictureDenoiser.of("rawaug-srgb@10")
    assert error(upright[0]) < error(two(Noisy(noisy()[None]))[0])


def test_a_network_that_is_told_a_level_sees_a_picture_upright_and_turned_by_a_quarter() -> None:
    seen = noisy()[None, :, :48]
    two, one = PictureDenoiser.of("rawaug-srgb@10"), PictureDenoiser.of("rawaug-srgb@10", views=1)
    upright = one(Noisy(seen))
    turned = bayer.turn_back(one(Noisy(bayer.turn(seen, 5))), 5)
    assert torch.allclose(two(Noisy(seen)), (upright + turned) / 2, atol=1e-5)
    assert (upright - turned).abs().max() > 1e-3
    assert PictureDenoiser.of("NonLocalMeans@10").views == 1


def test_bfloat16_changes_a_picture_by_less_than_two_codes() -> None:
    full, given = PictureDenoiser.of("rawaug-srgb@10"), Noisy(noisy()[None])
    assert not full.mixed
    change = (replace(full, mixed=True)(given) - full(given)).abs().max()
    assert 0.0 < change < 2 / 255


def test_ffdnet_is_told_the_deviation_of_its_noise() -> None:
    network = denoisers.build("FFDNet", width=8, depth=3)
    seen: list[Tensor] = []
    network.get_submodule("conv00").register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    network(torch.rand(1, 3, 16, 16), torch.full((1, 3, 16, 16), 0.01))
    assert seen[0].shape == (1, 15, 8, 8)
    assert torch.allclose(seen[0][:, :3], torch.tensor(0.1))


def test_a_refilled_network_sees_each_quarter_of_the_pixels_and_then_a_quarter_of_the_noisy_ones() -> None:
    class _Black(torch.nn.Module):
        def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
            seen.append(noisy.clone())
            return torch.zeros_like(noisy) if noisy.shape[0] == 4 else noisy

    seen: list[Tensor] = []
    picture = torch.rand(1, 3, 6, 8)
    result = Refilled(_Black())(picture, torch.zeros_like(picture))
    quarters = [picture[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
    assert torch.equal(seen[0], torch.cat(quarters))
    assert torch.allclose(result, picture / 4)


def test_a_refilled_network_is_named_in_the_benchmark(tmp_path: Path) -> None:
    save_weights(denoisers.build("FFDNet").state_dict(), tmp_path / "ffdnet.safetensors")
    refilled = PictureDenoiser.of(f"{tmp_path / 'ffdnet.safetensors'}+refill@50")
    assert "refilled" in refilled.name
    assert isinstance(refilled.network, Refilled)
    assert refilled.level == pytest.approx(50 / 255)
    with pytest.raises(ValueError, match="RAW"):
        PictureDenoiser.of("rawaug-small+refill")


def test_files_and_folders_of_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    write_picture(tmp_path / "in" / "a.png", noisy())
    (tmp_path / "in" / "b.jpg").write_bytes(b"not a picture")
    assert isinstance(files_for(tmp_path / "in"), PictureFiles)
    denoise(str(tmp_path / "in" / "a.png"), str(tmp_path / "a.png"))
    assert "noise of" in capsys.readouterr().out
    assert error(read_picture(tmp_path / "a.png") / 255.0) < 0.5 * error(noisy())
    result = denoise_folder(tmp_path / "in", tmp_path / "out", PictureFiles(PictureDenoiser.of("rawaug-srgb@5")))
    assert [one.out and one.out.name for one in result.files] == ["a.png"]
    assert list(result.broken) == [str(tmp_path / "in" / "b.jpg")]
    with pytest.raises(ValueError, match="exists"):
        denoise(str(tmp_path / "in" / "a.png"), str(tmp_path / "a.png"))
    with pytest.raises(ValueError, match=r"developed picture.*linear="):
        denoise(str(tmp_path / "in" / "a.png"), str(tmp_path / "c.png"), linear=True)


def test_pairs_of_pictures_are_scored_as_published_and_registered(tmp_path: Path) -> None:
    write_picture(tmp_path / "x_real.png", noisy())
    moved = torch.roll(smooth(), (1, 2), (1, 2)) * 0.95 + 0.02
    write_picture(tmp_path / "x_mean.png", moved)
    pairs = open_picture_pairs(f"cc15:{tmp_path}")
    assert [pair.name for pair in pairs] == ["x_real"] or len(pairs) == 1
    rows = picture_scores([PictureDenoiser.of("NonLocalMeans@10")], pairs)["rows"]
    found = rows["noisy input"]
    assert found[REGISTERED]["psnr"] > found[PUBLISHED]["psnr"] + 1.0
    inner = (..., slice(8, -8), slice(8, -8))
    assert (register(noisy(), moved)[inner] - smooth()[inner]).abs().mean() < 0.01
    with pytest.raises(ValueError, match="picture pairs"):
        open_picture_pairs("cc16:x")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        open_picture_pairs("polyu:nowhere")


def test_a_benchmark_of_pictures_crops_and_counts_and_refuses_what_is_for_raw(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_picture(tmp_path / f"{name}_real.png", noisy())
        write_picture(tmp_path / f"{name}_mean.png", smooth())
    command = ["benchmark", "NonLocalMeans@10", "--data", f"cc15:{tmp_path}"]
    scores = {}
    for options in ((), ("--count", "2", "--crop", "32")):
        file = tmp_path / f"{len(options)}.json"
        assert main([*command, *options, "--json", str(file)]) == 0
        scores[options] = json.loads(file.read_text())
    whole, cropped = scores.values()
    assert (whole["pictures"], cropped["pictures"], cropped["crop"]) == (3, 2, 32)
    assert whole["rows"]["noisy input"] != cropped["rows"]["noisy input"]
    of_raw: dict[str, Any] = {"bin": 2, "noise": "upi", "iso": [100.0], "seed": 1}
    of_raw |= {"report": str(tmp_path / "r.html"), "table": str(tmp_path / "t.tex")}
    for key, value in of_raw.items():
        with pytest.raises(ValueError, match=f"--{key} is for RAW"):
            benchmark("NonLocalMeans@10", data=f"cc15:{tmp_path}", **{key: value})


def test_a_cmyk_picture_is_refused_in_one_line(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    image.new("CMYK", (32, 32), (10, 20, 30, 0)).save(tmp_path / "print.jpg")
    with pytest.raises(ValueError, match=r"print.jpg: .*CMYK"):
        denoise(str(tmp_path / "print.jpg"), str(tmp_path / "out.jpg"))
    assert not (tmp_path / "out.jpg").exists()


def test_a_folder_s_pictures_of_formats_that_are_not_written_become_pngs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pillow = pytest.importorskip("PIL.Image")
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    write_picture(source / "a.png", noisy())
    pixels = (noisy() * 255.0).round().byte().permute(1, 2, 0).numpy()
    for name in ("a.bmp", "b.gif", "c.ppm"):
        pillow.fromarray(pixels).save(source / name)
    (source / "d.exr").write_bytes(b"\x76\x2f\x31\x01")
    frames = [pillow.fromarray(pixels), pillow.fromarray(255 - pixels)]
    frames[0].save(source / "e.gif", save_all=True, append_images=frames[1:])

    with pytest.raises(ValueError, match="1 of its files"):
        denoise(str(source), str(out), denoiser="NonLocalMeans@10")
    assert sorted(file.name for file in out.iterdir()) == ["a.bmp.png", "a.png", "b.gif.png", "c.ppm.png"]
    assert torch.equal(read_picture(out / "a.bmp.png"), read_picture(out / "a.png"))
    assert error(read_picture(out / "b.gif.png") / 255.0) < error(read_picture(source / "b.gif") / 255.0)

    *_, linear, formats = capsys.readouterr().out.splitlines()
    assert "1 picture left out (.exr 1)" in linear
    assert formats.startswith("3 results") and ".png" in formats and ".gif 1" in formats


def test_filters_and_the_list_of_what_was_done_are_for_pictures_too(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", noisy())
    filtering: Any = {"name": "TotalVariation", "settings": {}}
    denoise(str(tmp_path / "a.png"), str(tmp_path / "b.png"), classical=filtering, json=str(tmp_path / "done.json"))
    (done,) = json.loads((tmp_path / "done.json").read_text())["files"]
    assert done["deviation"] > 1.0 and done["out"].endswith("b.png")
    assert error(read_picture(tmp_path / "b.png") / 255.0) < error(noisy())


def test_python_takes_the_same_path_as_the_command(tmp_path: Path) -> None:
    picture = (torch.rand(3, 40, 48, generator=torch.Generator().manual_seed(0)) * 255).byte()
    write_picture(tmp_path / "a.png", picture.float() / 255.0)
    denoise(str(tmp_path / "a.png"), str(tmp_path / "b.png"), denoiser="NonLocalMeans@10")
    srgb = rawaug.denoise(tmp_path / "a.png", denoiser="NonLocalMeans@10")
    assert torch.equal((255.0 * srgb).round().byte(), read_picture(tmp_path / "b.png"))
    with pytest.raises(ValueError, match="noise= is for RAW"):
        rawaug.denoise(tmp_path / "a.png", noise="estimate")
