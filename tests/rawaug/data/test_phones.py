"""Simulated phones and DSLRs: the physics of a shot, the structure of SIDD, and splits that share no photograph."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
import torch

from rawaug.bayer import CFA, pack
from rawaug.data import open_pairs
from rawaug.data.dslrs import DslrFrames
from rawaug.data.phones import (
    CAMERAS,
    LIGHTS,
    WHITE,
    PhoneFrames,
    Shot,
    balance,
    colour_matrix,
    phone_curve,
    phone_noise,
    shading,
    take_shot,
)
from rawaug.data.scenes import camera_in_light, scene_files, white_point
from rawaug.data.selection import select_pairs
from rawaug.data.sidd_scenes import HELD_BACK, parse_label
from rawaug.io.pictures import write_picture

PLAIN = Shot(kelvin=5500, stops=0.5, iso=100, balance_error=0.0, tint_error=(0.0, 0.0), lift_error=0.0)
CODES = list(CAMERAS)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def grey(level: float = 0.4, size: int = 128) -> torch.Tensor:
    return torch.full((3, size, size), level)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k in range(10):
        noise = torch.randint(0, 256, (3, 24, 32), generator=generator(k)).to(torch.uint8)
        write_picture(tmp_path / f"{k}.png", noise)
    return tmp_path


# -- a shot ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("iso", [50, 1600])
def test_noise_has_the_published_levels_and_no_bias(code: str, iso: int) -> None:
    phone = CAMERAS[code]
    pair = take_shot(phone, grey(), PLAIN._replace(iso=iso), generator())
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    noise = (pair.noisy.mosaic - pair.clean.mosaic).double()
    step = 1 / (WHITE - phone.black)
    expected = (
        pair.noisy.noise_profile[0] * pair.clean.mosaic.double().mean() + pair.noisy.noise_profile[1] + step**2 / 12
    )
    assert noise.square().mean() / expected == pytest.approx(1, abs=0.06)
    assert abs(noise.mean()) < 5 * (expected / noise.numel()) ** 0.5


def test_noise_of_black_is_not_clipped() -> None:
    pair = take_shot(CAMERAS["N6"], grey(0.0), PLAIN._replace(iso=3200), generator())
    assert pair.noisy is not None
    assert (pair.noisy.mosaic < 0).float().mean() > 0.3


def test_levels_between_published_isos_lie_between_them_and_are_held_beyond() -> None:
    pixel = CAMERAS["GP"]
    assert phone_noise(pixel, 400) == pytest.approx((0.000886, 5e-6))
    shot, read = phone_noise(pixel, 200)
    assert 0.000228 < shot < 0.000886 and 2e-6 < read < 5e-6
    assert phone_noise(pixel, 50) == (0.000228, 2e-6)
    assert phone_noise(CAMERAS["G4"], 1600) == (0.003356, 6.3e-5)


@pytest.mark.parametrize("code", CODES)
def test_noisy_raw_has_ten_bits_and_the_pattern_of_the_phone(code: str) -> None:
    phone = CAMERAS[code]
    pair = take_shot(phone, torch.rand(3, 32, 48, generator=generator()), PLAIN, generator())
    assert pair.noisy is not None and pair.cfa == phone.cfa and pair.clean.camera == phone.name
    numbers = pair.noisy.mosaic.double() * (WHITE - phone.black) + phone.black
    assert (numbers - numbers.round()).abs().max() < 1e-3
    assert numbers.min() > -1e-3 and numbers.max() < WHITE + 1e-3
    assert pair.clean.mosaic.min() >= 0 and pair.clean.mosaic.max() <= 1


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("kelvin", LIGHTS)
def test_raw_of_grey_has_the_colour_of_the_light_to_the_camera(code: str, kelvin: int) -> None:
    phone = CAMERAS[code]
    pair = take_shot(phone, grey(), PLAIN._replace(kelvin=kelvin), generator())
    middle = pack(pair.clean.mosaic, phone.cfa)[:, 31:33, 31:33].mean((1, 2))
    response = camera_in_light(phone.xyz_to_camera, kelvin).sum(1)
    assert float(middle[0] / middle[1]) == pytest.approx(float(response[0] / response[1]), rel=0.01)
    assert float(middle[3] / middle[2]) == pytest.approx(float(response[2] / response[1]), rel=0.01)


@pytest.mark.parametrize("code", CODES)
def test_lamps_stay_warm_by_the_phones_own_share(code: str) -> None:
    phone = CAMERAS[code]
    lamp = take_shot(phone, grey(0.1), PLAIN._replace(kelvin=3200), generator()).srgb.float().mean((1, 2))
    assert lamp[0] > lamp[1] > lamp[2]
    knowing = phone._replace(rendering=phone.rendering._replace(adaptation=1.0))
    neutral = take_shot(knowing, grey(0.1), PLAIN._replace(kelvin=3200), generator()).srgb.float().mean((1, 2))
    assert float(neutral.max() - neutral.min()) < 2.0
    assert float(lamp.max() - lamp.min()) > 8.0


def test_a_warmer_picture_is_of_smaller_red_gains() -> None:
    gains = [balance(CAMERAS["IP"], PLAIN._replace(kelvin=kelvin)) for kelvin in LIGHTS]
    red = [float(value[0] / value[1]) for value in gains]
    blue = [float(value[2] / value[1]) for value in gains]
    assert red == sorted(red) and blue == sorted(blue, reverse=True)
    assert all(float(value.min()) == pytest.approx(1.0) for value in gains)


def test_a_dark_frame_is_lifted_by_parts() -> None:
    phone = CAMERAS["GP"]
    bright, dark = (take_shot(phone, grey(0.5), PLAIN._replace(stops=stops), generator()) for stops in (0.0, 2.0))
    ratio = float(dark.clean.mosaic.mean() / bright.clean.mosaic.mean())
    assert ratio == pytest.approx(0.25, rel=0.01)
    careless = phone._replace(rendering=phone.rendering._replace(lift=0.0))
    unlifted = take_shot(careless, grey(0.5), PLAIN._replace(stops=2.0), generator())
    levels = [float(pair.srgb.float().mean()) for pair in (unlifted, dark, bright)]
    assert levels[0] + 5.0 < levels[1] < levels[2] - 5.0


def test_the_white_balance_of_a_pair_is_the_renderers() -> None:
    shot = PLAIN._replace(tint_error=(0.2, -0.1))
    pair = take_shot(CAMERAS["G4"], grey(), shot, generator())
    gains = balance(CAMERAS["G4"], shot)
    assert pair.clean.white_balance == pytest.approx((float(gains[0] / gains[1]), 1.0, float(gains[2] / gains[1])))
    assert torch.allclose(pair.clean.color_matrix.sum(1), torch.ones(3), atol=1e-5)
    assert torch.allclose(pair.clean.color_matrix, colour_matrix(CAMERAS["G4"], shot).float())


@pytest.mark.parametrize("code", CODES)
def test_tone_curves_rise_from_black_to_white(code: str) -> None:
    law = CAMERAS[code].rendering
    curve = phone_curve(torch.linspace(0, 1, 4096), law.brightness, law.contrast)
    assert (curve.diff() > 0).all()
    assert curve[0] == pytest.approx(0, abs=1e-6) and curve[-1] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("code", CODES)
def test_shading_falls_off_from_a_point_off_centre(code: str) -> None:
    mask = shading(CAMERAS[code].shading, 200, 300)
    row, column = divmod(int(mask.argmax()), 300)
    assert (row, column) != (100, 150) and abs(row - 100) < 30 and abs(column - 150) < 30
    corners = mask[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert corners.min() > 0.35 and corners.max() < 0.75


def test_white_points_are_those_of_published_lights() -> None:
    expected = {2856: (0.4476, 0.4074), 6500: (0.3135, 0.3237)}
    for kelvin, (x, y) in expected.items():
        white = white_point(kelvin)
        assert float(white[0] / white.sum()) == pytest.approx(x, abs=0.001)
        assert float(white[1] / white.sum()) == pytest.approx(y, abs=0.001)
    with pytest.raises(ValueError, match="1,667"):
        white_point(500)


# -- the structure of SIDD ---------------------------------------------------------------------------------------------


def test_frames_have_the_names_and_counts_of_sidd() -> None:
    frames = PhoneFrames("", "train")
    assert len(frames) == 320 and len(set(frames.names)) == 320
    assert not {int(name[:4]) for name in frames.names} & {int(name[:4]) for name in HELD_BACK}
    phones = Counter(label.phone for label in frames.labels)
    assert set(phones.values()) == {64} and set(phones) == set(CAMERAS)
    for name, label in zip(frames.names, frames.labels, strict=True):
        instance, _, number = name.rpartition("_")
        assert parse_label(instance) == label and number in ("010", "011")
        assert 50 <= label.iso <= 3200


@pytest.mark.parametrize(("count", "scenes"), [(56, {"001"}), (184, {"001", "002", "003", "004", "005"})])
def test_published_counts_are_whole_scenes(count: int, scenes: set[str]) -> None:
    frames = PhoneFrames("", "train")
    chosen = select_pairs(frames, len(frames), count, "scenes")
    assert {frames.labels[k].scene for k in chosen} == scenes and len(chosen) == count


def test_five_pairs_are_one_of_each_phone() -> None:
    frames = PhoneFrames("", "train")
    chosen = select_pairs(frames, len(frames), 5, "phones")
    assert {frames.labels[k].phone for k in chosen} == set(CAMERAS)


def test_frames_held_back_are_sidds_with_their_phones() -> None:
    for split, number in (("validation", "011"), ("test", "010")):
        frames = PhoneFrames("", split)
        assert [name[:11] for name in frames.names] == [name[:11] for name in HELD_BACK]
        assert {name[-3:] for name in frames.names} == {number}


def test_a_frame_depends_on_seed_split_and_instance_alone(folder: Path) -> None:
    frames = PhoneFrames(folder, "train")
    last, first = frames[5], PhoneFrames(folder, "train")[0]
    assert torch.equal(PhoneFrames(folder, "train")[5].srgb, last.srgb)
    assert first.noisy is not None and frames[0].noisy is not None
    assert torch.equal(first.noisy.mosaic, frames[0].noisy.mosaic)
    other = open_pairs(f"phones:{folder}", split="train", seed=1)
    assert not torch.equal(other[0].clean.mosaic, first.clean.mosaic)


def test_two_frames_of_an_instance_differ_by_their_noise(folder: Path) -> None:
    frames = PhoneFrames(folder, "train")
    first, second = frames[0], frames[1]
    assert torch.equal(first.clean.mosaic, second.clean.mosaic) and torch.equal(first.srgb, second.srgb)
    assert first.noisy is not None and second.noisy is not None
    assert not torch.equal(first.noisy.mosaic, second.noisy.mosaic)


def test_splits_share_no_photograph(folder: Path) -> None:
    for path in ("", str(folder)):
        files = [set(scene_files(path, split)) for split in ("train", "validation", "test")]
        assert all(files) and not files[0] & files[1] and not files[0] & files[2] and not files[1] & files[2]


def test_subfolders_are_splits(folder: Path) -> None:
    for name, numbers in (("train", range(4)), ("test", range(4, 8))):
        (folder / name).mkdir()
        for k in numbers:
            (folder / f"{k}.png").rename(folder / name / f"{k}.png")
    names = {split: [file.stem for file in scene_files(folder, split)] for split in ("train", "validation", "test")}
    assert names == {"train": ["0", "1", "2", "3"], "validation": ["4", "6"], "test": ["5", "7"]}


def test_a_folder_with_too_few_pictures_says_so(tmp_path: Path) -> None:
    write_picture(tmp_path / "one.png", torch.zeros(3, 8, 8, dtype=torch.uint8))
    with pytest.raises(ValueError, match="five pictures"):
        open_pairs(f"phones:{tmp_path}", split="test")
    with pytest.raises(FileNotFoundError):
        open_pairs(f"phones:{tmp_path}/nowhere")


# -- DSLRs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", ["canon", "nikon"])
def test_a_dslr_frame_is_what_libraw_reads_and_renders(folder: Path, camera: str) -> None:
    pair = open_pairs(f"dslr_{camera}:{folder}")[0]
    assert pair.clean.mosaic.shape == (1, 512, 768) and pair.cfa == CFA.RGGB
    assert pair.clean.camera.endswith(("5D", "D700"))
    assert 1.2 < pair.clean.white_balance[0] < 3.5 and 0.8 < pair.clean.white_balance[2] < 2.5
    balanced = pack(pair.clean.mosaic, pair.cfa).mean((1, 2)) * torch.tensor(
        [pair.clean.white_balance[0], 1, 1, pair.clean.white_balance[2]]
    )
    assert float(balanced.max() / balanced.min()) < 1.6
    assert torch.equal(open_pairs(f"dslr_{camera}:{folder}")[0].clean.mosaic, pair.clean.mosaic)


def test_a_dslrs_jpeg_is_near_its_rendering(folder: Path) -> None:
    plain = open_pairs(f"dslr_nikon:{folder}")[0]
    jpeg = open_pairs(f"dslr_nikon_jpeg:{folder}")[0]
    assert torch.equal(plain.clean.mosaic, jpeg.clean.mosaic) and not torch.equal(plain.srgb, jpeg.srgb)
    assert (plain.srgb.float() - jpeg.srgb.float()).abs().mean() < 6


def test_an_unknown_dslr_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="no camera leica"):
        DslrFrames(folder, "test", "leica")
