"""A camera by the figures of its data sheet: what is stated is what the pairs have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

import rawaug
from rawaug.camera.lights import SRGB_TO_XYZ, XYZ_TO_SRGB, adaptation, light_xyz
from rawaug.camera.matrices import daylight_gains, load_cameras
from rawaug.camera.own import Camera
from rawaug.commands import info
from rawaug.data import demo_pairs
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.isp.model import DictionaryISP
from rawaug.noise.measured import MeasuredNoise
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.config import AugmentConfig

CCM = [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]]
"""White-balanced camera RGB to linear sRGB."""
GAINS = {"A": [1.31, 1.0, 2.64], "D65": [2.1, 1.0, 1.7]}
NOISE = {100: {"K": 0.12, "sigma": 1.1}, 800: {"K": 0.96, "sigma": 2.4}, 3200: {"K": 3.84, "sigma": 7.0}}
"""DN an electron, and DN of read noise, by ISO."""
SHEET: dict[str, Any] = {
    "name": "Maker M1",
    "matrix": CCM,
    "matrix_is": "camera_to_srgb",
    "white_balance": GAINS,
    "cfa": "GRBG",
    "black_level": 64,
    "white_level": 1000,
    "bits": 10,
    "noise": NOISE,
    "tone": "linear",
}
FULL_SCALE = 1000 - 64


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data sheet as a file."""
    path = tmp_path_factory.mktemp("camera") / "mine.yaml"
    path.write_text(yaml.safe_dump(SHEET))
    return path


def patches(*colours: tuple[int, int, int], side: int = 128) -> Tensor:
    """Uniform pictures ``(B, 3, side, side)``."""
    return torch.tensor(colours, dtype=torch.uint8)[:, :, None, None].expand(-1, -1, side, side).contiguous()


def linear(colours: Tensor) -> Tensor:
    codes = colours.double() / 255
    return torch.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize(("light", "iso"), [("A", 100), ("D65", 800), ("A", 3200)])
def test_pairs_have_the_colours_and_the_noise_of_the_sheet(sheet: Path, light: str, iso: int) -> None:
    draw = rawaug.Draw(light=light, exposure=0.0)
    augment = RawAugment.from_pretrained("universal", camera=sheet, iso=iso, draw=draw)
    pictures = patches((150, 150, 150), (200, 60, 40), (40, 120, 180), side=512)
    pair = augment(pictures, torch.Generator().manual_seed(0))

    gains = torch.tensor(GAINS[light], dtype=torch.float64)
    expected = linear(pictures[:, :, 0, 0]) @ torch.linalg.inv(torch.tensor(CCM, dtype=torch.float64)).T / gains
    expected *= gains.min()  # the least gain of a pair is 1
    rggb = expected[:, [0, 1, 1, 2]]
    clean = pair.clean.double().mean((2, 3))
    assert torch.allclose(clean, rggb, rtol=0.01, atol=1e-4)

    levels = NOISE[iso]
    stated = levels["K"] / FULL_SCALE * clean + (levels["sigma"] / FULL_SCALE) ** 2
    measured = (pair.noisy - pair.clean).double().var((2, 3))
    assert ((measured / stated - 1).mean(0).abs() < 0.01).all()
    told = augment.noise.variance(pair.clean, pair.params.noise)
    assert torch.allclose(told.double().mean((2, 3)), stated, rtol=0.01)

    digital = pair.noisy * FULL_SCALE
    assert (digital - digital.round()).abs().max() < 1e-3
    assert augment.cfa == "GRBG" and pair.noisy.max() <= 1.0


def test_pairs_replay_bit_for_bit(sheet: Path, tmp_path: Path) -> None:
    augment = RawAugment.from_pretrained(sheet)
    pictures = torch.randint(256, (4, 3, 32, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    pair = augment(pictures, torch.Generator().manual_seed(1))
    rawaug.save_params(pair.params, tmp_path / "params.safetensors")

    other = RawAugment(Camera.load(sheet))
    again = other.apply(pictures, rawaug.load_params(tmp_path / "params.safetensors"))
    assert torch.equal(again.noisy, pair.noisy) and torch.equal(again.clean, pair.clean)
    assert len({tuple(gains) for gains in pair.params.isp.gains.tolist()}) == 4, "any light is drawn by default"


def test_info_prints_the_sheet_back(sheet: Path) -> None:
    text = info.describe_file(sheet)
    for part in ("Maker M1", "GRBG", "black 64, white 1000 DN", "gains 1.3100 1.0000 2.6400", "ISO 3200", "linear"):
        assert part in text
    content = info.read_facts(sheet)
    assert Camera.from_json(content["figures"]) == Camera.load(sheet)
    assert content["lights"]["D65"]["gains"] == pytest.approx(GAINS["D65"])
    assert content["noise"][1]["shot_var"] == pytest.approx(0.96 / FULL_SCALE)


def test_it_lasts_in_the_files_of_an_isp_and_of_a_run(sheet: Path, tmp_path: Path) -> None:
    isp = DictionaryISP.from_pretrained(sheet)
    isp.save(tmp_path / "mine.safetensors")
    config = AugmentConfig(camera=str(sheet), iso=800)
    assert AugmentConfig.from_json(config.to_json()) == config and config.noise == "camera"

    picture = patches((90, 120, 60), side=16)
    pairs = []
    for augment in (RawAugment(isp), RawAugment.from_pretrained(tmp_path / "mine.safetensors", noise="camera")):
        pairs.append(augment(picture, torch.Generator().manual_seed(0)).noisy)
    assert torch.equal(*pairs)
    assert config.make().cfa == "GRBG"


def test_matrices_of_two_lights_meet_between_them() -> None:
    warm = [[0.9, -0.2, -0.05], [-0.5, 1.3, 0.2], [-0.1, 0.3, 0.5]]
    (cold,) = load_cameras().select(["Nikon D750"]).tolist()
    camera = Camera("Two lights", matrix={"A": warm, 6504: cold}, matrix_is="xyz_to_camera")
    first, last = camera.anchors()
    assert [first.light, last.light] == ["A", "6504"]

    # Each matrix takes the white of its own light to neutral, and its colours to those of Bradford's adaptation.
    for anchor, matrix in ((first, warm), (last, cold)):
        response = torch.tensor(matrix, dtype=torch.float64) @ light_xyz(anchor.light)
        assert torch.allclose(response * anchor.gains, response[1].expand(3))
        adapted = torch.tensor(matrix).double() @ adaptation(light_xyz("D65"), light_xyz(anchor.light)) @ SRGB_TO_XYZ
        assert torch.allclose(anchor.matrix, adapted / adapted.sum(1, keepdim=True))

    drawn = {}
    for light in ("A", "6504", 3900):
        augment = RawAugment(camera, noise="upi", draw=rawaug.Draw(light=light, exposure=0.0))
        drawn[light] = augment.sample(patches((9, 9, 9), side=4), torch.Generator().manual_seed(0)).isp
    assert torch.allclose(drawn["A"].matrix[0].double(), first.matrix, atol=1e-6)
    assert torch.allclose(drawn["6504"].matrix[0].double(), last.matrix, atol=1e-6)
    assert (drawn[3900].colour_weights > 0.2).all()


def test_a_published_camera_by_its_figures_is_that_camera() -> None:
    (matrix,) = load_cameras().select(["Nikon D750"])
    own = Camera("D750", matrix=matrix.tolist(), matrix_is="xyz_to_camera").anchors()[0]
    assert torch.allclose(own.gains, daylight_gains(matrix), rtol=1e-3)
    srgb = own.matrix @ torch.linalg.inv(XYZ_TO_SRGB) @ XYZ_TO_SRGB
    of_srgb = Camera("D750", matrix=srgb.tolist(), matrix_is="srgb_to_camera", white_balance=own.gains).anchors()[0]
    assert torch.allclose(of_srgb.from_xyz, own.from_xyz, rtol=1e-6)


def test_several_cameras_mix_as_published_ones_do(sheet: Path) -> None:
    other = Camera(
        "M2", matrix=CCM, matrix_is="camera_to_srgb", white_balance=(1.6, 1.0, 1.4), cfa="GRBG", noise=(1e-3, 1e-5)
    )
    with pytest.raises(ValueError, match="different digital numbers"):
        RawAugment.from_pretrained("universal", camera=[sheet, other])

    mixed = RawAugment.from_pretrained("universal", "upi", camera=[sheet, other, "Nikon D750"])
    weights = mixed.sample(torch.zeros(200, 3, 2, 2), torch.Generator().manual_seed(0)).isp.colour_weights
    of_cameras = torch.stack([weights[:, :2].sum(1), weights[:, 2], weights[:, 3]], dim=1)
    assert torch.allclose(of_cameras.sum(1), torch.ones(200))
    assert ((of_cameras > 0.01).sum(1) <= 2).all() and (of_cameras.mean(0) > 0.2).all()
    assert mixed.isp.info["cameras"] == ["Maker M1", "M2", "Nikon D750"] and mixed.cfa == "GRBG"


def test_an_own_tone_curve_is_inverted() -> None:
    points = [(0.0, 0.0), (0.1, 0.4), (0.5, 0.8), (1.0, 1.0)]
    camera = Camera("Toned", matrix=torch.eye(3), matrix_is="srgb_to_camera", white_balance=(1, 1, 1), tone=points)
    augment = RawAugment(camera, (0.0, 0.0), draw=rawaug.Draw(light="D65", exposure=0.0))
    grey = torch.tensor([0.2, 0.4, 0.6, 0.8])[:, None, None, None].expand(-1, 3, 4, 4)
    assert torch.allclose(augment(grey).clean.mean((1, 2, 3)), torch.tensor([0.05, 0.1, 0.3, 0.5]), atol=1e-3)


def test_mosaics_of_other_patterns() -> None:
    camera = Camera("Quad", matrix=torch.eye(3), matrix_is="srgb_to_camera", white_balance=(1, 1, 1), cfa="QUAD-RGGB")
    augment = RawAugment(camera)
    assert augment.cfa == "QUAD-RGGB" and augment(torch.rand(1, 3, 16, 16)).noisy.shape == (1, 1, 16, 16)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"matrix_is": "ccm"}, "matrix_is"),
        ({"matrix": [[1, 0], [0, 1]]}, "3 x 3"),
        ({"matrix": [[2.0, 0, 0], [0, 1, 0], [0, 0, 1]]}, "keep white"),
        ({"white_balance": None}, "needs the gains"),
        ({"white_balance": (2.0, 1.0, -1.0)}, "from 0.01 to 100"),
        ({"white_balance": (1e308, 1.0, 1.0)}, "white_balance"),
        ({"matrix": [[0, 0, 0]] * 3}, "inverted"),
        ({"matrix": [[10**4000, 0, 0], [0, 1, 0], [0, 0, 1]]}, "matrix has a number beyond"),
        ({"white_level": 10**4000, "bits": None}, "white_level has a number beyond"),
        ({"noise": {10**4000: (1e-4, 1e-6)}}, "noise has a number beyond"),
        ({"noise": {100: {"K": 1e8, "sigma": 1.1}}}, "as no sensor has"),
        ({"tone": [(0, 0), (0.5, 10**4000), (1, 1)]}, "tone has a number beyond"),
        ({"white_balance": {"D66": (2, 1, 2)}}, "D66"),
        ({"cfa": "XXXX"}, "cfa"),
        ({"bits": 99}, "bits"),
        ({"black_level": 1001}, "below white"),
        ({"white_level": 1024}, "10 bits"),
        ({"bits": None, "white_level": None}, "bits or white_level"),
        ({"noise": {100: (0.12, 1.1)}}, "read_var|shot_var|noise_in"),
        ({"noise": {100: (0.96, 2.4)}}, "noise_in"),
        ({"noise": {100: {"K": 0.12}}}, "sigma"),
        ({"noise": {-1: (1e-4, 1e-6)}}, "ISO"),
        ({"noise": {100: (1e-4, 1e-9)}}, "rounding"),
        ({"noise": {100: (-1e-4, 1e-6)}}, "negative"),
        ({"tone": [(0, 0), (0.5, 0.4), (0.4, 1)]}, "tone"),
        ({"name": " "}, "name"),
    ],
)
def test_wrong_figures_are_named(change: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Camera(**{**SHEET, **change})


def test_files_of_strangers_are_refused_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    for content, word in (
        ("name: a\nmatrx: 1", "matrix"),
        ("- 1", "keys"),
        ("a: &x [1]\nb: *x", "aliases"),
        ("{", "YAML|camera"),
        ("name: !!int", "camera"),
        ("name: !!bool x", "camera"),
    ):
        path.write_text(content)
        with pytest.raises(ValueError, match=word):
            Camera.load(path)
    with pytest.raises(FileNotFoundError):
        DictionaryISP.from_pretrained(tmp_path / "other.yaml")
    path.write_text(yaml.safe_dump({**SHEET, "tone": "nikn like"}))
    with pytest.raises(ValueError, match=r"mine\.yaml: .*nikon like"):
        DictionaryISP.from_pretrained(path)
    tone = {**SHEET, "tone": "nikn like"}
    with pytest.raises(ValueError, match="nikon like"):
        RawAugment(Camera(**tone))


def test_levels_by_iso_are_those_of_the_law() -> None:
    spec = Camera(**{**SHEET, "bits": None}).noise_spec()
    assert spec is not None
    model = MeasuredNoise(**spec["settings"], iso=(100, 800))
    params = model.sample(500, torch.Generator().manual_seed(0))
    assert "quantum" not in params
    assert float(params["shot_var"].min()) >= 0.999 * 0.12 / FULL_SCALE
    assert float(params["shot_var"].max()) <= 1.001 * 0.96 / FULL_SCALE


def test_a_sheet_states_banding_tails_and_hot_pixels() -> None:
    further = {"row": 2.0, "column": 1.5, "lambda": -0.1, "hot": 1e-3}
    noise = {100: {"K": 0.12, "sigma": 3.0, **further}, 400: {"K": 0.48, "sigma": 6.0, **further, "row": 8.0}}
    camera = Camera(**{**SHEET, "noise": noise})
    augment = RawAugment.from_pretrained("universal", camera=camera, iso=400)
    params = augment.sample(torch.zeros(1, 3, 512, 512), torch.Generator().manual_seed(0))
    assert float(params.camera()["ISO"]) == 400
    noisy = augment.apply(torch.zeros(1, 3, 512, 512), params).noisy[0] * camera.full_scale
    is_hot = noisy > 100
    assert is_hot.float().mean() == pytest.approx(1e-3, rel=0.15)
    dark = noisy.clamp(max=40.0)
    rows = dark.unflatten(0, (2, 2)).mean((1, 3))
    columns = torch.stack([dark[::2].mean((0, 1)), dark[1::2].mean((0, 1))])
    assert rows.std() == pytest.approx(8.0, rel=0.06) and columns.std() == pytest.approx(1.5, rel=0.06)
    read = dark - dark.mean(2, keepdim=True) - dark.mean(1, keepdim=True) + dark.mean((1, 2), keepdim=True)
    assert read.std() == pytest.approx(6.0, rel=0.03)
    assert (read.abs() > 4 * 6.0).float().mean() > 1e-3, "tails"

    spec = camera.noise_spec()
    assert spec is not None
    isos = MeasuredNoise(**spec["settings"]).sample(200, torch.Generator().manual_seed(0))
    row = isos["row_var"].sqrt() * camera.full_scale
    assert row.tolist() == pytest.approx((2.0 * isos["iso"] / 100).tolist(), rel=1e-3), "between the ISO values"
    with pytest.raises(ValueError, match="some ISO values only"):
        Camera(**{**SHEET, "noise": {100: noise[100], 400: {"K": 0.48, "sigma": 6.0}}})


@pytest.mark.parametrize("name", ["pmrid", "NikonD850", "Sony ILCE-7M3", "any camera", "iPhone 7"])
def test_pairs_say_the_iso_of_their_noise(name: str) -> None:
    augment = RawAugment.from_pretrained("universal", noise={"name": name, "settings": {"iso": (400, 800)}})
    iso = augment(torch.rand(8, 3, 16, 16)).params.camera()["ISO"]
    assert iso.shape == (8,) and bool(((iso > 399.9) & (iso < 800.1)).all())
    assert "ISO" not in RawAugment.from_pretrained("universal", noise="upi")(torch.rand(1, 3, 16, 16)).params.camera()


@pytest.mark.parametrize("count", [1])
def test_a_fit_that_starts_from_a_camera_is_no_worse(count: int) -> None:
    matrix = torch.tensor(((1.66, -0.53, -0.13), (-0.21, 1.55, -0.34), (0.02, -0.47, 1.45)))  # of the demo's camera
    start = Camera(
        "Demo", matrix=matrix / matrix.sum(1, keepdim=True), matrix_is="camera_to_srgb", white_balance=(2, 1, 1.6)
    )
    settings: dict[str, Any] = {"steps": 20, "curve_steps": 60, "pixels": 2048, "progress": False, "noise": "off"}
    frames, others = demo_pairs("train", count=count), demo_pairs("test", count=2)
    scores = []
    for camera in (None, start):
        isp = rawaug.fit(frames, camera=camera, **settings)
        scores.append(sum(psnr_r(isp, pair, white_balance=True) for pair in others) / len(others))
    assert scores[1] > scores[0] - 0.1
