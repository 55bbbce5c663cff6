from __future__ import annotations

import dataclasses
import errno
import inspect
import json
import multiprocessing
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
import torch
from torch import Tensor

import denoisers
import rawaug
from rawaug.bayer import CFA, mosaic, pack, unpack
from rawaug.cli import main
from rawaug.commands.denoise import print_denoised, run
from rawaug.denoising.denoise import files_for
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.folder import DenoisedFolder, denoise_file, denoise_folder
from rawaug.denoising.levels import find_levels
from rawaug.denoising.raw import OTHER_PATTERNS, RawFiles
from rawaug.io import RawFrame, read_picture, read_raw, write_dng, write_picture
from rawaug.io.cells import MONOCHROME
from rawaug.noise import noise_levels

LEVELS = (1e-3, 1e-5)
Dng = Callable[..., Path]


def a_scene(cfa: CFA) -> Tensor:
    """Linear ramps, ``(1, 96, 128)``, as the mosaic of a camera."""
    y, x = torch.meshgrid(torch.linspace(0.05, 0.6, 96), torch.linspace(0.05, 0.8, 128), indexing="ij")
    return mosaic(torch.stack([x, y, (x + y) / 2]), cfa)


def shot(path: Path, bayer_dng: Dng, cfa: CFA = CFA.RGGB, black: int = 511, **tags: Any) -> Path:
    raw = a_scene(cfa)
    noise = torch.randn(raw.shape, generator=torch.Generator().manual_seed(0))
    noisy = raw + noise * (LEVELS[0] * raw + LEVELS[1]).sqrt()
    numbers = (noisy[0] * (16383 - black) + black).round().clamp(0, 16383).numpy().astype(np.uint16)
    return bayer_dng(path, numbers, cfa.value, black=(black,), white=16383, noise_profile=LEVELS, **tags)


class LocalMean(denoisers.UNet):
    """A denoiser that is known: the mean of 5 x 5 packed pixels, of each plane."""

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        assert variance is not None
        self.seen = float(variance.min()), float(variance.max())
        return torch.nn.functional.avg_pool2d(noisy, 5, 1, 2, count_include_pad=False)


@pytest.fixture
def adding(tmp_path: Path) -> Callable[[float], Path]:
    """``adding(x)``: the weights of an untrained network, which adds x to every value."""

    def weights(value: float) -> Path:
        network, path = denoisers.UNet(width=4, scales=2), tmp_path / "weights" / "adding.safetensors"
        assert network.last.bias is not None
        torch.nn.init.constant_(network.last.bias, value)
        path.parent.mkdir(exist_ok=True)
        denoisers.save(network, path, {"cfa": "GRBG"})
        return path

    return weights


@pytest.mark.parametrize("own", list(CFA))
@pytest.mark.parametrize("self_ensemble", [False, True])
def test_a_frame_of_any_pattern_becomes_cleaner_where_it_stands(
    tmp_path: Path, bayer_dng: Dng, own: CFA, self_ensemble: bool
) -> None:
    frame = read_raw(shot(tmp_path / "a.dng", bayer_dng, own))
    model, packed = LocalMean(width=4, scales=2), pack(frame.mosaic[None], own)
    denoiser = RawDenoiser.of(model, cfa=CFA.GRBG, views=8 if self_ensemble else 1)
    denoised = unpack(denoiser(Noisy.of(packed, LEVELS, own)), own)[0]
    assert denoised.shape == frame.mosaic.shape
    clean = a_scene(own)
    inner = (..., slice(12, -12), slice(12, -12))
    before, after = ((x - clean)[inner].square().mean() for x in (frame.mosaic, denoised))
    assert after < before / 10
    for i in (0, 1):
        for j in (0, 1):  # no cast: every site of the cell on its own
            assert abs((denoised - clean)[inner][0, i::2, j::2].mean()) < 1e-3
    assert model.seen[1] == pytest.approx(LEVELS[0] * frame.mosaic.max().item() + LEVELS[1], rel=0.01)


def test_a_denoiser_that_changes_nothing_gives_the_source_back(tmp_path: Path, bayer_dng: Dng, identity: Path) -> None:
    source = shot(tmp_path / "a.dng", bayer_dng, orientation=6)
    _, result = denoise_file(source, tmp_path / "out" / "b.dng", RawFiles(identity))
    assert (result.shot_var, result.read_var, result.noise_source) == (*LEVELS, "profile") and result.below_zero == 0
    before, after = read_raw(source), read_raw(tmp_path / "out" / "b.dng")
    assert torch.equal(before.mosaic, after.mosaic)
    for key in ("cfa", "black", "white", "white_balance", "camera", "orientation", "iso", "daylight"):
        assert getattr(before, key) == getattr(after, key), key
    assert torch.equal(before.color_matrix, after.color_matrix)
    assert after.noise_profile is None


def test_help_is_about_the_function() -> None:
    assert inspect.isfunction(rawaug.denoise) and "source: a RAW file" in (inspect.getdoc(rawaug.denoise) or "")


def test_greens_that_differ_are_balanced_and_kept_on_request(
    tmp_path: Path, bayer_dng: Dng, identity: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    patches = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    raw = mosaic(0.1 + 0.6 * torch.nn.functional.interpolate(patches, (512, 512), mode="bilinear")[0], CFA.RGGB)
    raw[:, 0::2, 1::2] *= 1.02
    numbers = (raw[0] * 16000 + 383).round().numpy().astype(np.uint16)
    source = bayer_dng(tmp_path / "a.dng", numbers, "RGGB", black=(383,), white=16383, noise_profile=LEVELS)
    command = ["denoise", str(source), "--denoiser", str(identity), "--json", str(tmp_path / "done.json")]
    gaps = {}
    for greens in ("auto", "keep"):
        out = tmp_path / f"{greens}.dng"
        assert main([*command[:2], str(out), *command[2:], "--greens", greens, "--overwrite"]) == 0
        done = json.loads((tmp_path / "done.json").read_text())["files"][0]
        assert done["balanced"] is (greens == "auto") and done["greens"]["share"] == pytest.approx(0.02, rel=0.2)
        assert ("greens balanced" in capsys.readouterr().out) is (greens == "auto")
        packed = pack(read_raw(out).mosaic, CFA.RGGB)
        gaps[greens] = float((packed[1] - packed[2]).mean())
    assert abs(gaps["auto"]) < 0.1 * gaps["keep"]
    with pytest.raises(ValueError, match=r"greens: .*auto"):
        rawaug.denoise(source, denoiser=identity, greens="off")  # type: ignore[arg-type]


def test_below_the_digital_number_0_is_counted(tmp_path: Path, bayer_dng: Dng, adding: Callable[[float], Path]) -> None:
    source = shot(tmp_path / "a.dng", bayer_dng, black=0)
    _, result = denoise_file(source, tmp_path / "b.dng", RawFiles(adding(-0.1), guard=False))
    expected = (read_raw(source).mosaic < 0.1 - 0.5 / 16383).float().mean().item()
    assert result.below_zero == pytest.approx(expected, abs=1e-3) and expected > 0.01
    assert read_raw(tmp_path / "b.dng").mosaic.min() == 0


def test_where_the_levels_come_from(tmp_path: Path, bayer_dng: Dng) -> None:
    frame = read_raw(shot(tmp_path / "a.dng", bayer_dng))
    assert find_levels(frame) == (*LEVELS, "profile")
    assert find_levels(frame, (1e-2, 1e-4)) == (1e-2, 1e-4, "given")
    phone = dataclasses.replace(frame, iso=800.0)
    assert find_levels(phone, "Google Pixel")[0] == pytest.approx(0.001764, rel=1e-3)
    for camera in ("SonyA7S2", "NikonD850"):  # the law itself, not a draw about it
        draws = noise_levels(camera, iso=800).sample(4001, torch.Generator().manual_seed(0))[1]
        assert find_levels(phone, camera)[1] == pytest.approx(draws.median().item(), rel=0.05)
    with pytest.raises(ValueError, match="a: ISO 800000"):
        find_levels(dataclasses.replace(frame, iso=8e5), "Google Pixel")
    with pytest.raises(ValueError, match="not negative"):
        find_levels(frame, (-1e-3, -0.1))
    with pytest.raises(ValueError, match="ISO"):
        find_levels(frame, "Google Pixel")
    with pytest.raises(ValueError, match="'upi'"):
        find_levels(frame, "upi")
    assert find_levels(phone, "nikon d5000")[0] == find_levels(phone, "Nikon D5000")[0] > 0
    bare = dataclasses.replace(frame, noise_profile=None)
    with pytest.raises(ValueError, match="NoiseProfile"):
        find_levels(bare, "profile")
    with pytest.raises(ValueError, match="noise="):
        find_levels(bare)


@pytest.mark.parametrize("wrong", [0.5, 1.0, 1.4, 4.0])
def test_a_tag_that_the_frame_contradicts_or_lacks_gives_way_to_the_estimate(wrong: float) -> None:
    frame = dataclasses.replace(gradient(), noise_profile=(wrong * LEVELS[0], wrong * LEVELS[1]))
    shot_var, _, noise_source = find_levels(frame)
    if wrong in (0.5, 4.0):
        assert noise_source.startswith("estimate; the NoiseProfile tag says ")
        assert float(noise_source.split()[5]) == pytest.approx(wrong, rel=0.1)
        assert shot_var == pytest.approx(LEVELS[0], rel=0.1)
    else:
        assert (shot_var, noise_source) == (wrong * LEVELS[0], "profile")
    assert find_levels(frame, "profile")[0] == wrong * LEVELS[0]
    shot_var, read_var, noise_source = find_levels(gradient())
    assert noise_source.startswith("estimate, R^2 0.9") and read_var < 4e-5
    assert shot_var == pytest.approx(LEVELS[0], rel=0.1)


def test_an_uncertain_estimate_says_what_to_compare(capsys: pytest.CaptureFixture[str]) -> None:
    """On a line for photographers: half of the frame has four times the noise, so the variances follow no line."""
    frame = dataclasses.replace(gradient(), camera="Nikon D5000", iso=200.0)
    extra = torch.randn(frame.mosaic.shape, generator=torch.Generator().manual_seed(1))
    extra[..., frame.mosaic.shape[-1] // 2 :] = 0
    frame = dataclasses.replace(frame, mosaic=(frame.mosaic + 0.06 * extra).clamp(max=1.0))
    _, done = RawFiles(RawDenoiser.of("NonLocalMeans", strength=0.5), noise="estimate").denoise(frame)
    assert ", estimated, 50% of it removed" in str(done)
    assert "uncertain" in str(done) and 'noise="Nikon D5000"' in str(done)
    assert "shot_var" not in str(done) and "R^2" not in str(done)
    assert "shot_var" in done.details and "R^2" in done.details

    print_denoised(DenoisedFolder([done]))
    assert "--strength 0.7 and --noise 'Nikon D5000'" in capsys.readouterr().out
    _, sure = RawFiles("NonLocalMeans", noise="estimate").denoise(gradient())
    assert "uncertain" not in str(sure) and ", estimated, removed" in str(sure)


def gradient() -> RawFrame:
    """From dark to light, with noise of :data:`LEVELS` and no tag."""
    generator = torch.Generator().manual_seed(0)
    clean = torch.linspace(0.02, 0.9, 640).expand(1, 640, 640)
    noisy = clean + (LEVELS[0] * clean + LEVELS[1]).sqrt() * torch.randn(clean.shape, generator=generator)
    return RawFrame(
        noisy.clamp(max=1), CFA.RGGB, (64.0,) * 4, 1023.0, (1.0,) * 3, (1.0,) * 3, torch.eye(3), "x", None, None, 0, "a"
    )


def test_a_strength_below_1_leaves_that_much_of_the_noise(
    tmp_path: Path, bayer_dng: Dng, adding: Callable[[float], Path]
) -> None:
    source, brighter = shot(tmp_path / "a.dng", bayer_dng), adding(0.1)
    denoise_file(source, tmp_path / "b.dng", RawFiles(RawDenoiser.of(brighter, strength=0.75), guard=False))
    before, after = read_raw(source), read_raw(tmp_path / "b.dng")
    assert (after.mosaic - before.mosaic).mean().item() == pytest.approx(0.075, abs=1e-4)
    assert after.noise_profile == pytest.approx((LEVELS[0] / 16, LEVELS[1] / 16))
    denoise_file(source, tmp_path / "c.dng", RawFiles(RawDenoiser.of(brighter, strength=0.0)))
    assert torch.equal(read_raw(tmp_path / "c.dng").mosaic, before.mosaic)


@pytest.mark.parametrize("deviation", [0.004, 0.02, 0.1])
def test_strength_auto_leaves_the_same_grain_in_every_frame(deviation: float) -> None:
    """Of white noise on mid grey, by a denoiser that knows the scene; noise below the grain is left."""
    noise = 0.18 * deviation * torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0))
    frame = dataclasses.replace(gradient(), mosaic=0.18 + noise)
    levels = 0.0, (0.18 * deviation) ** 2
    files = files_for(frame, lambda packed: torch.full_like(packed, 0.18), "auto", noise=levels)
    result, done = files.denoise(frame)
    assert (result.mosaic.std() / 0.18).item() == pytest.approx(min(deviation, 0.01), rel=0.02)
    assert done.strength == pytest.approx(max(0.0, 1 - 0.01 / deviation))
    assert files.settings is not None and files.settings["strength"] == "auto"
    if deviation > 0.01:
        assert result.noise_profile[1] == pytest.approx(0.0018**2)


def test_in_bfloat16_a_network_of_dense_convolutions_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, results = gradient(), []
    for fast in (False, True):
        monkeypatch.setattr("rawaug.denoising.denoiser.has_fast_bfloat16", lambda device, fast=fast: fast)
        results.append(RawDenoiser.of("rawaug-base", "cpu", "auto").frame(frame, (1e-3, 1e-5)))
    assert results[1].dtype == torch.float32 and not torch.equal(*results)
    assert (results[0] - results[1]).std() < 0.03 * (results[0] - frame.mosaic).std()


def test_a_filter_denoises_without_a_network(tmp_path: Path, bayer_dng: Dng) -> None:
    clean = a_scene(CFA.RGGB)
    source = shot(tmp_path / "a.dng", bayer_dng)
    out = str(tmp_path / "b.dng")
    assert main(["denoise", str(source), out, "--classical", "NonLocalMeans"]) == 0
    before, after = ((read_raw(path).mosaic - clean)[..., 8:-8, 8:-8].square().mean() for path in (source, out))
    assert after < before / 3
    frame = read_raw(source)
    white = dataclasses.replace(frame, mosaic=clean + 0.01 * torch.randn(clean.shape))
    rest = (RawDenoiser.of("TotalVariation").frame(white, (0.0, 1e-4)) - clean).square().mean()
    assert rest < 1e-4 / 2


def test_what_is_there_stays_without_overwrite(
    tmp_path: Path, bayer_dng: Dng, identity: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    source, out, preview = shot(tmp_path / "a.dng", bayer_dng, orientation=6), tmp_path / "b.dng", tmp_path / "p.jpg"
    command = ["denoise", str(source), str(out), "--denoiser", str(identity), "--noise", "[0.002, 1e-5]"]
    assert main([*command, "--preview", str(preview)]) == 0
    assert "b.dng: noise of 10.7 % of mid grey, as given, removed" in capsys.readouterr().out
    assert read_picture(preview).shape == (3, 128, 96)  # upright
    before = out.stat().st_mtime_ns
    assert "b.dng: exists; give another name, or --overwrite" in refused(*command)
    assert "p.jpg: exists" in refused(*command[:2], tmp_path / "c.dng", *command[3:], "--preview", preview)
    assert not (tmp_path / "c.dng").exists() and out.stat().st_mtime_ns == before
    assert main([*command, "--overwrite", "--verbose"]) == 0
    assert out.stat().st_mtime_ns > before
    assert "shot_var 0.002, read_var 1e-05 (given)" in capsys.readouterr().out


def test_a_full_disk_ends_a_folder_in_one_line(
    tmp_path: Path, bayer_dng: Dng, identity: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for name in "abc":
        shot(source / f"{name}.dng", bayer_dng)

    def write(path: Path, *rest: Any, **colours: Any) -> None:
        if path.stem != "a":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_dng(path, *rest, **colours)

    monkeypatch.setattr("rawaug.denoising.raw.write_dng", write)
    assert main(["denoise", str(source), str(out), "--denoiser", str(identity)]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert "b.dng" in said[-1] and "No space left on device" in said[-1] and "c.dng" not in str(said)
    assert (out / "a.dng").is_file()


def test_folders_are_resumed_and_fail_where_a_file_is_broken(
    tmp_path: Path, bayer_dng: Dng, identity: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    (source / "sub").mkdir(parents=True)
    (source / "broken.nef").write_bytes(b"no RAW")
    shot(source / "a.dng", bayer_dng), shot(source / "sub" / "a.dng", bayer_dng)
    command = ["denoise", str(source), str(out), "--denoiser", str(identity)]
    assert main(command) == 2
    said = capsys.readouterr()
    assert (out / "a.dng").is_file() and (out / "sub" / "a.dng").is_file() and "broken.nef" in said.out
    assert said.err.strip().splitlines()[-1].endswith("1 of its files could not be denoised; they are listed above")
    (out / "sub" / "a.dng").unlink()
    again = denoise_folder(source, out, RawFiles(identity))
    assert (len(again.files), again.existing, len(again.broken)) == (1, 1, 1)
    other_noise = refused(*command, "--noise", "estimate")
    assert "denoise.json: made with noise auto, not estimate" in other_noise and "--overwrite" in other_noise
    assert "made with strength None, not 0.5" in refused(*command, "--strength", "0.5")
    before = (out / "a.dng").stat().st_mtime_ns
    (source / "broken.nef").unlink()
    assert main([*command, "--strength", "0.5", "--overwrite"]) == 0
    assert (out / "a.dng").stat().st_mtime_ns > before
    assert main([*command, "--strength", "0.5"]) == 0
    (source / "a.nef").write_bytes(b"no RAW")
    assert "has this stem" in refused(*command)


def test_of_unknown_noise_files_of_the_same_camera_and_iso_tell(tmp_path: Path, identity: Path) -> None:
    known = dataclasses.replace(gradient(), camera="Maker One", iso=400.0, noise_profile=LEVELS)
    bare = dataclasses.replace(known, mosaic=known.mosaic[..., :64, :64], noise_profile=None)
    frames = {"a": bare, "b": known, "c": dataclasses.replace(bare, iso=800.0)}
    frames["d"] = dataclasses.replace(bare, camera="Maker Two")
    (tmp_path / "in").mkdir()
    for name, frame in frames.items():
        write_dng(tmp_path / "in" / f"{name}.dng", frame)
    result = denoise_folder(tmp_path / "in", tmp_path / "out", RawFiles(identity))
    assert [done.source and done.source.stem for done in result.files] == ["b", "a"]
    assert (result.files[1].shot_var, result.files[1].read_var) == pytest.approx(LEVELS)
    assert result.files[1].noise_source == "other files of Maker One at ISO 400"
    reasons = sorted(result.broken.values())
    assert [reason[:17] for reason in reasons] == ["noise unknown: c:", "noise unknown: d:"]


@pytest.mark.usefixtures("no_gpu")
def test_wrong_wishes_are_refused_before_anything_is_written(
    tmp_path: Path,
    bayer_dng: Dng,
    identity: Path,
    joint: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused: Callable[..., str],
) -> None:
    monkeypatch.setitem(sys.modules, "bm3d", None)
    source, folder, out = shot(tmp_path / "a.dng", bayer_dng), tmp_path / "in", tmp_path / "b.dng"
    shots = tmp_path / "shots"
    folder.mkdir()
    shots.mkdir()
    shot(shots / "a.dng", bayer_dng)
    for wish, message in (
        (["--device", "cdua"], "device 'cdua' is unknown; use one of auto, cpu, cuda"),
        (["--device", "cuda"], "this machine has none"),
        (["--classical", "BM3D"], "bm3d is not installed"),
        (["--classical", "Wavelte"], "nearest: Wavelet"),
        (["--classical", "Wavelet", "--denoiser", "rawaug-small"], "give one or the other"),
        (["--classical", "Wavelet", "--linear"], "a filter takes no --denoiser, --self-ensemble or --linear"),
        (["--preview", tmp_path / "b.gif"], "the preview is a .jpg or .png"),
        (["--preview", tmp_path], "is a folder"),
        (["--denoiser", identity, "--strength", "1.5"], "strength must be between 0 and 1, got 1.5"),
        (["--denoiser", identity, "--strength", "atuo"], "strength"),
        (["--denoiser", joint, "--linear", "--strength", "auto"], "takes no --strength"),
        (["--denoiser", identity, "--linear"], "--linear demosaics, too, use rawaug-joint"),
        (["--denoiser", joint], "demosaics too, to a linear DNG; add --linear"),
        (["--denoiser", joint, "--linear", "--strength", "0.5"], "takes no --strength"),
        (["--denoiser", joint, "--linear", "--preview", "p.png"], "--preview p.png: --linear does not support it"),
    ):
        assert message in refused("denoise", source, out, *wish)
    for names, message in (
        ((source, source), "is the input file"),
        ((source, tmp_path / "b.tif"), "name ending in .dng"),
        ((tmp_path / "gone.dng", out), "gone.dng: no such file"),
        ((shots, tmp_path / "out", "--preview", "p.jpg"), "give a folder"),
        ((folder, out), "in is a folder, and so is its output; give a name without .dng"),
        ((shots, shots / "out"), "choose an output folder outside"),
    ):
        assert message in refused("denoise", *names, "--denoiser", identity)
    assert not out.exists()


def test_12_megapixels_take_less_than_2_gib(tmp_path: Path, bayer_dng: Dng, identity: Path) -> None:
    numbers = np.random.default_rng(0).integers(400, 4000, (3000, 4000)).astype(np.uint16)
    bayer_dng(tmp_path / "a.dng", numbers, black=(64,), noise_profile=LEVELS)
    code = """
import resource
from rawaug.cli import main
assert main(command) == 0
out.write_text(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
"""
    command = ["denoise", str(tmp_path / "a.dng"), str(tmp_path / "b.dng"), "--denoiser", str(identity)]
    variables = {"command": command, "out": tmp_path / "peak"}
    process = multiprocessing.get_context("forkserver").Process(target=exec, args=(code, variables))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert int((tmp_path / "peak").read_text()) < 2 * 2**20  # KiB


@pytest.fixture
def joint(tmp_path: Path) -> Path:
    """The weights of a network that interpolates."""
    denoisers.save(denoisers.JointDRUNet(width=4, scales=2, mend=False), tmp_path / "joint.safetensors", {})
    return tmp_path / "joint.safetensors"


@pytest.mark.parametrize("own", list(CFA))
def test_linear_dngs_have_the_colours_of_the_scene(tmp_path: Path, bayer_dng: Dng, joint: Path, own: CFA) -> None:
    source, out = shot(tmp_path / "a.dng", bayer_dng, own), tmp_path / "out.dng"
    run(str(source), str(out), linear=True, denoiser=str(joint), noise=(1e-9, 1e-9))
    y, x = np.mgrid[0.05:0.6:96j, 0.05:0.8:128j]
    with rawpy.imread(str(out)) as file:
        numbers = file.raw_image_visible.astype(np.float64)
        linear = {"gamma": (1, 1), "no_auto_bright": True, "adjust_maximum_thr": 0, "output_bps": 16, "user_flip": 0}
        developed = file.postprocess(output_color=rawpy.ColorSpace.raw, user_wb=[1, 1, 1, 1], **linear) / 65535
    signal = numbers[..., :3] / 65535
    assert developed.mean((0, 1)) == pytest.approx(signal.mean((0, 1)), rel=1e-3), "LibRaw shows it as bright"
    for colour, expected in enumerate((x, y, (x + y) / 2)):
        assert abs((signal[..., colour] - expected)[8:-8, 8:-8].mean()) < 1e-3, "no shift, no cast"


@pytest.mark.parametrize("name", ["loop.dng", "loop.jpg"])
def test_a_link_to_itself_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    (tmp_path / name).symlink_to(tmp_path / name)
    with pytest.raises(OSError, match=rf"{name}"):
        run(str(tmp_path / name), str(tmp_path / f"out-{name}"))


def test_a_folder_has_a_preview_of_each_file(tmp_path: Path, bayer_dng: Dng, identity: Path) -> None:
    (tmp_path / "in" / "sub").mkdir(parents=True)
    shot(tmp_path / "in" / "a.dng", bayer_dng), shot(tmp_path / "in" / "sub" / "a.dng", bayer_dng, orientation=6)
    command = ["denoise", str(tmp_path / "in"), str(tmp_path / "out"), "--denoiser", str(identity)]
    assert main([*command, "--preview", str(tmp_path / "previews")]) == 0
    assert read_picture(tmp_path / "previews" / "a.jpg").shape == (3, 96, 128)
    assert read_picture(tmp_path / "previews" / "sub" / "a.jpg").shape == (3, 128, 96)

    lost = (tmp_path / "previews" / "sub" / "a.jpg").read_bytes()
    (tmp_path / "previews" / "sub" / "a.jpg").unlink()  # as if a run had been stopped before it
    assert main([*command, "--preview", str(tmp_path / "previews")]) == 0
    assert (tmp_path / "previews" / "sub" / "a.jpg").read_bytes() == lost


def test_previews_replace_no_picture_of_the_camera(
    tmp_path: Path, bayer_dng: Dng, identity: Path, refused: Callable[..., str]
) -> None:
    for folder in ("in", "elsewhere"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.jpg").write_bytes(b"the camera's own")
    shot(tmp_path / "in" / "a.dng", bayer_dng)
    command = ["denoise", tmp_path / "in", tmp_path / "out", "--denoiser", identity, "--preview"]
    assert "in: is inside the source folder" in refused(*command, tmp_path / "in")
    assert "a.jpg: exists" in refused(*command, tmp_path / "elsewhere")
    for folder in ("in", "elsewhere"):
        assert (tmp_path / folder / "a.jpg").read_bytes() == b"the camera's own"
    assert not (tmp_path / "out" / "a.dng").exists()


def test_a_folder_names_what_is_left_out(
    tmp_path: Path, bayer_dng: Dng, identity: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    shot(tmp_path / "in" / "a.dng", bayer_dng)
    for name in ("a.x3f", "b.x3f", "a.jpg", "notes.txt"):
        (tmp_path / "in" / name).write_bytes(b"")
    assert main(["denoise", str(tmp_path / "in"), str(tmp_path / "out"), "--denoiser", str(identity)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and "2 RAW files left out (.x3f 2): there is no decoder" in lines[2]


def test_a_mixed_folder_is_denoised_whole_but_for_the_cameras_own_renderings(
    tmp_path: Path, bayer_dng: Dng, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    shot(tmp_path / "in" / "a.dng", bayer_dng)
    picture = torch.rand(3, 40, 48, generator=torch.Generator().manual_seed(0))
    for name in ("a.jpg", "b.jpg", "c.png"):
        write_picture(tmp_path / "in" / name, picture)
    (tmp_path / "in" / "notes.txt").write_text("mine")

    assert main(["denoise", str(tmp_path / "in"), str(tmp_path / "out"), "--noise", "[1e-3, 1e-5]"]) == 0
    results = {file.name for file in (tmp_path / "out").iterdir() if file.suffix in (".dng", ".jpg", ".png")}
    assert results == {"a.dng", "b.jpg", "c.png"}
    printed = capsys.readouterr().out
    assert "1 rendering left out (.jpg 1)" in printed and "1 other file left out (.txt 1)" in printed
    assert "picture left out" not in printed and "pictures left out" not in printed


def test_the_shipped_denoiser_of_each_pattern_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    by_pattern = RawFiles(noise=LEVELS)
    for cfa in ("GBRG", "XTRANS", "QUAD-RGGB", MONOCHROME):
        expected = OTHER_PATTERNS if cfa in ("XTRANS", "QUAD-RGGB") else "rawaug-base"
        assert by_pattern.denoiser_for(cfa).name == expected
    scene = 0.2 + 0.01 * torch.randn(1, 96, 96, generator=torch.Generator().manual_seed(0))
    write_dng(tmp_path / "a.dng", RawFrame(scene, "XTRANS", (512.0,) * 4, 16383.0, noise_profile=(4e-4, 2e-5)))
    assert main(["denoise", str(tmp_path / "a.dng"), str(tmp_path / "b.dng")]) == 0
    assert read_raw(tmp_path / "b.dng").mosaic.std() < 0.002
    with pytest.raises(ValueError, match="rawaug-xtrans"):
        rawaug.denoise(RawFrame(scene, "XTRANS"), denoiser="rawaug-small", noise=LEVELS)


def test_a_monochrome_frame_is_denoised_as_one_plane(tmp_path: Path) -> None:
    ramp = torch.linspace(0.05, 0.5, 192).expand(1, 128, 192)
    noise = torch.randn(ramp.shape, generator=torch.Generator().manual_seed(0))
    noisy = ramp + noise * (LEVELS[0] * ramp + LEVELS[1]).sqrt()
    write_dng(tmp_path / "a.dng", RawFrame(noisy, MONOCHROME, (512.0,) * 4, 16383.0, noise_profile=LEVELS))
    assert main(["denoise", str(tmp_path / "a.dng"), str(tmp_path / "b.dng"), "--preview", "p.png"]) == 0
    denoised = read_raw(tmp_path / "b.dng", monochrome=True)
    assert denoised.cfa == MONOCHROME and denoised.noise_profile is None
    assert (denoised.mosaic - ramp).square().mean() < (noisy - ramp).square().mean() / 20
    for i in (0, 1):
        for j in (0, 1):  # no site of the four is another than its neighbours
            assert abs((denoised.mosaic - ramp)[0, i::2, j::2].mean()) < 2e-3
    picture = read_picture("p.png")
    assert (picture[0] == picture[1]).all() and (picture[1] == picture[2]).all()


@pytest.mark.parametrize("profile", [(1e-3, -1e-5), (0.0, 0.0), (float("nan"), 1e-5)])
def test_a_noise_profile_out_of_range_is_told_and_replaced(
    profile: tuple[float, float],
    tmp_path: Path,
    bayer_dng: Dng,
    identity: Path,
    capsys: pytest.CaptureFixture[str],
    refused: Callable[..., str],
) -> None:
    numbers = (gradient().mosaic[0] * (16383 - 511) + 511).round().numpy().astype(np.uint16)
    source = bayer_dng(tmp_path / "a.dng", numbers, black=(511,), white=16383, noise_profile=profile)
    command = ["denoise", str(source), str(tmp_path / "b.dng"), "--denoiser", str(identity)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "NoiseProfile is out of range" in said and ", estimated, removed" in said
    assert "out of range" in refused(*command, "--overwrite", "--noise", "profile")


def test_raw_under_another_name_is_denoised_as_raw(tmp_path: Path, bayer_dng: Dng, identity: Path) -> None:
    source = shot(tmp_path / "a.dng", bayer_dng).rename(tmp_path / "a.tif")
    assert main(["denoise", str(source), str(tmp_path / "b.dng"), "--denoiser", str(identity)]) == 0
    assert torch.equal(read_raw(source).mosaic, read_raw(tmp_path / "b.dng").mosaic)
