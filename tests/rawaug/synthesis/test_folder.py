from __future__ import annotations

import multiprocessing
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import rawpy
import tifffile
import torch

from rawaug import Burst, Camera, DictionaryISP, ISPConfig, RawAugment, Srgb
from rawaug.bayer import CFA, pack
from rawaug.cli import main
from rawaug.files import replacing
from rawaug.io import read_picture, read_raw, write_picture
from rawaug.noise import estimate_noise
from rawaug.synthesis.files import camera_frames, replay
from rawaug.synthesis.folder import synth

FIXED = (2e-3, 1e-4)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures, two of them of one stem, and a broken one."""
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "sub").mkdir()
    generator = torch.Generator().manual_seed(0)
    for name, size in (("a.png", (64, 96)), ("a.jpg", (63, 65)), ("sub/b.png", (96, 64)), ("c.png", (64, 64))):
        coarse = torch.rand(1, 3, 8, 8, generator=generator)
        write_picture(folder / name, torch.nn.functional.interpolate(coarse, size, mode="bilinear")[0])
    (folder / "broken.jpg").write_bytes((folder / "a.jpg").read_bytes()[:300])
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_every_picture_that_can_be_read_has_pairs_of_its_own(tmp_path: Path, pictures: Path) -> None:
    result = synth(pictures, tmp_path, format="npz", per_image=2, workers=0)
    assert (result.pictures, result.made, result.existing) == (5, 8, 0)
    assert list(result.broken) == ["broken.jpg"] and "broken.jpg" in result.broken["broken.jpg"]
    files = sorted(tmp_path.rglob("*.safetensors"))
    stems = [str(file.relative_to(tmp_path).with_suffix("")) for file in files]
    assert stems == [f"{stem}_{k}" for stem in ("a_jpg", "a_png", "c", "sub/b") for k in (0, 1)]
    first, second, *rest = (replay(file) for file in files)
    assert not torch.equal(first.clean, second.clean) and not torch.equal(first.noisy, second.noisy)
    seeds = {pair.params.noise["seed"].item() for pair in (first, second, *rest)}
    assert len(seeds) == 8, "pictures or numbers share their draws"
    with np.load(files[-1].with_suffix(".npz")) as file:
        assert np.array_equal(file["clean"], rest[-1].clean.numpy()) and rest[-1].clean.shape == (4, 48, 32)
        assert file["shot_var"] == rest[-1].params.noise["shot_var"].numpy() and str(file["cfa"]) == "RGGB"


@pytest.mark.parametrize(
    ("target", "format", "ends"),
    [
        ("raw", "dng", {"_clean.dng", "_noisy_0.dng", "_noisy_1.dng"}),
        ("raw", "tiff", {"_clean.tif", "_noisy_0.tif", "_noisy_1.tif"}),
        ("rgb", "tiff", {"_clean.tif", "_noisy_0.tif", "_noisy_1.tif"}),
        ("srgb", "tiff", {"_clean.tif", "_noisy_0.tif", "_noisy_1.tif"}),
        ("srgb", "png", {"_clean.png", "_noisy_0.png", "_noisy_1.png"}),
        ("srgb", "npz", {".npz"}),
    ],
)
def test_bursts_of_every_target_replay(
    tmp_path: Path, pictures: Path, target: str, format: str, ends: set[str]
) -> None:
    picture, out = pictures / "sub" / "b.png", tmp_path / "out"
    held = Srgb(jpeg=(50, 90)) if target == "srgb" else target
    settings: dict[str, Any] = {"format": format, "noise": FIXED, "target": held, "burst": Burst(2, motion=(1.0, 0.1))}
    synth(picture, out, workers=0, **settings)
    pair = replay(out / "b_0.safetensors")
    assert {file.name for file in out.iterdir()} == {f"b_0{end}" for end in ends} | {"b_0.safetensors", "synth.json"}
    noisy = {k: pair.noisy[k] for k in (0, 1)}
    if format == "npz":
        with np.load(out / "b_0.npz") as file:
            assert np.array_equal(file["noisy"], pair.noisy.numpy()) and file["clean"].shape == (3, 96, 64)
    elif format == "png":
        for end, expected in (("clean", pair.clean), ("noisy_1", noisy[1])):
            read = read_picture(out / f"b_0_{end}.png") / 255.0
            torch.testing.assert_close(read, expected, atol=0.51 / 255, rtol=0)
    elif format == "dng":
        frame = read_raw(out / "b_0_noisy_1.dng")
        step = 1 / (frame.white - frame.black[0])
        torch.testing.assert_close(pack(frame.mosaic, frame.cfa), noisy[1], atol=0.51 * step, rtol=0)
        with rawpy.imread(str(out / "b_0_noisy_0.dng")) as raw:
            assert raw.postprocess(use_camera_wb=True).shape == (96, 64, 3)
    elif target == "raw":
        mosaics = [torch.from_numpy(tifffile.imread(out / f"b_0_{end}.tif"))[None] for end in ("clean", "noisy_1")]
        assert torch.equal(pack(mosaics[0], "RGGB"), pair.clean) and torch.equal(pack(mosaics[1], "RGGB"), noisy[1])
    else:
        clean = torch.from_numpy(tifffile.imread(out / "b_0_clean.tif").astype(np.float32)).permute(2, 0, 1)
        scale = 65535 if target == "srgb" else 1
        torch.testing.assert_close(clean / scale, pair.clean, atol=0.51 / 65535, rtol=0)
    assert synth(picture, out, workers=0, **settings).made == 0
    with pytest.raises(ValueError, match=r"synth\.json: .*burst"):
        synth(picture, out, workers=0, **settings | {"burst": 2})


def test_pairs_do_not_depend_on_what_was_there(tmp_path: Path, pictures: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    synth(pictures, whole, per_image=2, workers=0)
    synth(pictures, parts, per_image=1, workers=0)
    for file in parts.rglob("a_png_0*"):
        file.unlink()
    with replacing(parts / "c_1_clean.dng") as partial:
        partial.touch()
        abandoned = partial.name
    (parts / "c_1_clean.dng").unlink()
    (parts / abandoned).write_bytes(b"a run that was killed here")
    again = synth(pictures, parts, per_image=2, workers=0)
    assert (again.made, again.existing) == (5, 3)
    assert contents(parts) == contents(whole)
    assert synth(pictures, parts, per_image=2, workers=0).made == 0
    other = synth(pictures, tmp_path / "other", seed=1, workers=0).out
    assert contents(other)["c_0_noisy.dng"] != contents(whole)["c_0_noisy.dng"]


def test_what_is_gone_torn_or_of_another_picture_is_made_again(tmp_path: Path, pictures: Path) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(pictures, source)
    synth(source, out, workers=0)
    whole = contents(out)
    (out / "c_0_noisy.dng").unlink()
    (out / "sub/b_0_clean.dng").write_bytes(whole["sub/b_0_clean.dng"][:100])
    again = synth(source, out, workers=0)
    assert again.made == 2 and contents(out) == whole

    other = torch.full((3, 96, 64), 90, dtype=torch.uint8)
    write_picture(source / "sub" / "b.png", other)
    assert synth(source, out, workers=0).made == 1
    assert contents(out)["sub/b_0_clean.dng"] != whole["sub/b_0_clean.dng"]
    assert contents(out)["c_0_clean.dng"] == whole["c_0_clean.dng"]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to see the processes of a session")
def test_a_killed_run_leaves_no_worker(tmp_path: Path, pictures: Path) -> None:
    many, out = tmp_path / "many", tmp_path / "out"
    many.mkdir()
    for k in range(20):
        (many / f"{k}.png").write_bytes((pictures / "a.png").read_bytes())
    code = "import os; os.setsid(); from rawaug.synthesis.folder import synth; synth(many, out, workers=1)"
    process = multiprocessing.get_context("forkserver").Process(target=exec, args=(code, {"many": many, "out": out}))
    process.start()
    assert process.pid is not None
    while not list(out.glob("*.safetensors")) and process.is_alive():
        time.sleep(0.01)
    process.kill()
    process.join()
    for _ in range(100):
        if not others_in_session(process.pid):
            break
        time.sleep(0.1)
    assert not others_in_session(process.pid) and len(list(out.glob("*.safetensors"))) < 20


def others_in_session(session: int) -> list[str]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended meanwhile
            continue
        if fields[0] != "Z" and fields[3] == str(session):
            found.append(stat.parent.name)
    return found


def test_the_dngs_have_the_right_metadata(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    ramp = torch.linspace(0.1, 0.9, 512)[None, :, None].expand(3, 512, 512)
    write_picture(tmp_path / "in/ramp.png", ramp)
    synth(tmp_path / "in", tmp_path / "out", noise=FIXED, workers=0)
    clean, noisy = (read_raw(tmp_path / f"out/ramp_0_{name}.dng") for name in ("clean", "noisy"))
    assert noisy.noise_profile == pytest.approx(FIXED) and clean.noise_profile is None
    assert noisy.black == clean.black and noisy.mosaic.min() < -0.01 < 0 <= clean.mosaic.min() + 1e-4
    estimate = estimate_noise(noisy.mosaic, noisy.cfa)
    assert estimate.shot_var == pytest.approx(FIXED[0], rel=0.1)
    balanced = pack(clean.mosaic, clean.cfa)[[0, 1, 3]].mean((1, 2)) * torch.tensor(clean.white_balance)
    assert balanced / balanced[1] == pytest.approx(torch.ones(3), abs=0.03), "grey is not neutral"


def test_lens_shading_comes_as_a_gain_map() -> None:
    isp = DictionaryISP(ISPConfig(attention=False))
    cast(Any, isp.stages["shading"]).mask.set(torch.tensor([0.1, -0.2]), torch.eye(2))
    augment = RawAugment(isp, noise=(0.0, 0.0))
    srgb = torch.full((3, 64, 96), 0.5)
    pair = augment.apply(srgb, augment.sample(srgb, torch.Generator().manual_seed(0)))
    frames, stops = camera_frames(pair, augment)
    clean = frames["_clean"]
    (gains,) = (m.gains[None] for m in clean.gain_maps)
    rows, columns = ((torch.arange(side) + 0.5) / side * 2 - 1 for side in (64, 96))  # nodes are at the edges
    place = torch.stack(torch.meshgrid(rows, columns, indexing="ij")[::-1], dim=-1)[None]
    flat = pack(clean.mosaic * torch.nn.functional.grid_sample(gains, place, align_corners=True)[0], clean.cfa)
    assert clean.mosaic.std() / clean.mosaic.mean() > 0.05
    assert (flat.std((1, 2)) / flat.mean((1, 2))).max() < 1e-3
    rgb = flat[[0, 1, 3]].mean((1, 2)) * torch.tensor(clean.white_balance) * 2**stops
    assert rgb == pytest.approx(torch.full((3,), 0.5**2.2), rel=1e-2)


def test_the_shading_of_a_sheet_comes_as_a_map_for_each_site() -> None:
    red = [[0.5, 0.8, 0.6], [0.9, 1.0, 0.8], [0.6, 0.9, 0.4]]
    green = [[0.7, 0.9, 0.8], [0.9, 1.0, 0.9], [0.8, 0.9, 0.6]]
    colours: dict[str, Any] = {
        "matrix": [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]],
        "matrix_is": "camera_to_srgb",
    }
    camera = Camera("M1", **colours, white_balance=(2.1, 1.0, 1.7), cfa="GRBG", shading=[red, green, green])
    augment = RawAugment(camera, noise=(0.0, 0.0))
    srgb = torch.full((3, 64, 96), 0.5)
    pair = augment.apply(srgb, augment.sample(srgb, torch.Generator().manual_seed(0)))
    clean = camera_frames(pair, augment)[0]["_clean"]
    assert clean.mosaic.std() / clean.mosaic.mean() > 0.05 and len(clean.gain_maps) == 4
    for plane, (top, left), corrections in zip(
        pack(clean.mosaic, clean.cfa), CFA.GRBG.sites, clean.gain_maps, strict=True
    ):
        assert corrections.area[:2] == (top, left)
        y, x = (torch.arange(top, 64, 2) + 0.5) / 32 - 1, (torch.arange(left, 96, 2) + 0.5) / 48 - 1
        place = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1)[None]
        flat = plane * torch.nn.functional.grid_sample(corrections.gains[None], place, align_corners=True)[0, 0]
        assert flat.std() / flat.mean() < 3e-3


def test_what_cannot_be_is_refused(tmp_path: Path, pictures: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere:"):
        synth(tmp_path / "nowhere", tmp_path / "out")
    with pytest.raises(ValueError, match="inside"):
        synth(pictures, pictures / "out", workers=0)
    with pytest.raises(ValueError, match="'bogus' is unknown"):
        synth(pictures, tmp_path / "out", noise="bogus", workers=0)
    for format, target in (("dng", "srgb"), ("dng", "rgb"), ("png", "raw")):
        with pytest.raises(ValueError, match=f"{format}.*{target}.*npz, tiff"):
            synth(pictures, tmp_path / "out", format=format, target=target, workers=0)  # type: ignore[arg-type]
    synth(pictures, tmp_path / "out", workers=0)
    with pytest.raises(ValueError, match=r"synth\.json: .*made"):
        synth(pictures, tmp_path / "out", seed=1, workers=0)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "x.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="none"):
        synth(tmp_path / "in", tmp_path / "none", workers=0)


def test_one_picture_of_a_named_camera_as_other_sensors_see_it(
    tmp_path: Path, pictures: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    drawn = ["--camera", "Nikon D750", "--light", "4000", "--tone", "linear", "--exposure=-0.5", "--seed", "3"]
    drawn += ["--noise", "Nikon D750", "--iso", "1600", "--workers", "0"]
    command = ["synth", str(pictures / "sub" / "b.png"), str(tmp_path / "out"), "--cfa", "XTRANS", *drawn]
    assert main([*command, "--format", "npz"]) == 0
    assert "pairs made" in capsys.readouterr().out
    with np.load(tmp_path / "out" / "b_0.npz") as file:
        assert str(file["cfa"]) == "XTRANS" and file["noisy"].shape == (1, 96, 64)
        pair = replay(tmp_path / "out" / "b_0.safetensors")
        assert np.array_equal(file["noisy"], pair.noisy.numpy()) and np.array_equal(file["clean"], pair.clean.numpy())
    assert "made with format npz, not tiff" in refused(*command, "--format", "tiff")
    quad = [*command[:2], str(tmp_path / "quad"), "--cfa", "QUAD-RGGB", *drawn]
    assert main([*quad, "--format", "tiff"]) == 0
    mosaic = torch.from_numpy(tifffile.imread(tmp_path / "quad" / "b_0_clean.tif"))
    assert torch.equal(mosaic[None], replay(tmp_path / "quad" / "b_0.safetensors").clean)
    assert main([*command[:2], str(tmp_path / "dng"), "--cfa", "XTRANS", *drawn, "--format", "dng"]) == 0
    frame, pair = read_raw(tmp_path / "dng" / "b_0_noisy.dng"), replay(tmp_path / "dng" / "b_0.safetensors")
    assert frame.cfa == "XTRANS" and (frame.mosaic - pair.noisy).abs().max() < 1e-5


def test_replay_wants_what_the_pair_was_made_of(tmp_path: Path, pictures: Path) -> None:
    (tmp_path / "in").mkdir()
    picture = tmp_path / "in" / "c.png"
    picture.write_bytes((pictures / "c.png").read_bytes())
    synth(tmp_path / "in", tmp_path / "out", workers=0)
    params = tmp_path / "out/c_0.safetensors"
    before = replay(params)
    moved = picture.rename(tmp_path / "moved.png")
    with pytest.raises(FileNotFoundError, match=r"c\.png"):
        replay(params)
    assert torch.equal(replay(params, picture=moved).noisy, before.noisy)
    with pytest.raises(ValueError, match="has changed since"):
        replay(params, picture=pictures / "sub/b.png")
    DictionaryISP().save(tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="pair"):
        replay(params, picture=moved, isp=tmp_path / "other.safetensors")


def test_the_first_pair_that_is_not_finite_ends_the_run(tmp_path: Path, pictures: Path) -> None:
    isp = DictionaryISP.from_pretrained("universal")
    isp.get_buffer("colour.known").fill_(3e38)
    isp.save(tmp_path / "absurd.safetensors")
    with pytest.raises(ValueError, match="weights"):
        synth(pictures, tmp_path / "out", format="npz", isp=str(tmp_path / "absurd.safetensors"), workers=0)
    assert not list((tmp_path / "out").glob("*.npz"))
