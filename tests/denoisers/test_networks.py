"""The contract that every network keeps: shapes, identity before training, errors, types, export."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

import denoisers
from denoisers import DHDN, PMRID, CycleISPDenoiser, Denoiser, DnCNN, DRUNet, NAFNet, UNet
from denoisers.defects import mend_planes
from denoisers.drunet import ResidualBlock
from denoisers.layers import can_fuse, pad_to_multiple
from rawaug import bayer

Make = Callable[..., Any]

SMALL: dict[str, Make] = {
    "UNet": lambda **settings: UNet(width=4, **settings),
    "DHDN": lambda **settings: DHDN(width=4, **settings),
    "CycleISPDenoiser": lambda **settings: CycleISPDenoiser(
        **{"width": 8, "groups": 1, "blocks": 2, "reduction": 4, **settings}
    ),
    "DnCNN": lambda **settings: DnCNN(width=8, depth=4, **settings),
    "PMRID": lambda **settings: PMRID(width=4, **{"domain": "linear", "variance_map": True, **settings}),
    "NAFNet": lambda **settings: NAFNet(width=4, encoder=(1, 1), middle=1, decoder=(1, 1), **settings),
    "DRUNet": lambda **settings: DRUNet(width=4, scales=3, blocks=1, **settings),
}


@pytest.fixture(params=SMALL)
def make(request: pytest.FixtureRequest) -> Make:
    return SMALL[request.param]


def pair(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator) - 0.1, torch.rand(shape, generator=generator) * 1e-2


def awake(model: Denoiser, seed: int = 5) -> Denoiser:
    """The zero weights drawn as well, so that the residual is not zero."""
    model.initialise(seed)
    with torch.no_grad():
        for key, weight in model.named_parameters():
            if key.endswith(("beta", "gamma")):
                weight.fill_(0.5)  # NAFNet's residuals start at zero
            elif "norm" not in key:
                weight.mul_(0.7)  # DHDN's residual blocks would double the signal fourteen times
    return model.eval()


@pytest.mark.parametrize("size", [(2, 2), (2, 33), (17, 5), (16, 32), (31, 48)])
def test_any_size_is_kept_and_the_untrained_network_is_the_identity(make: Make, size: tuple[int, int]) -> None:
    noisy, variance = pair(2, 4, *size)
    assert torch.equal(make().eval()(noisy, variance), noisy)
    denoised = awake(make())(noisy, variance)
    assert denoised.shape == noisy.shape and denoised.isfinite().all() and not torch.allclose(denoised, noisy)


def test_no_picture_depends_on_its_batch(make: Make) -> None:
    noisy, variance = pair(3, 4, 20, 24)
    model = awake(make())
    together = model(noisy, variance)
    torch.testing.assert_close(model(noisy[1:2], variance[1:2]), together[1:2], rtol=1e-4, atol=1e-4)


def test_the_noise_map_is_required_and_read(make: Make) -> None:
    noisy, variance = pair(1, 4, 16, 16)
    model = awake(make(deviation=True))
    with pytest.raises(ValueError, match="variance_map"):
        model(noisy)
    with pytest.raises(ValueError, match="shape"):
        model(noisy, variance[:, :1])
    assert not torch.allclose(model(noisy, variance), model(noisy, 2 * variance))
    squared = awake(make(deviation=False))
    assert torch.equal(squared(noisy, variance.sqrt()), model(noisy, variance))


def test_a_blind_network_takes_the_picture_alone(make: Make) -> None:
    noisy, variance = pair(1, 4, 16, 16)
    model = awake(make(variance_map=False))
    assert torch.equal(model(noisy), model(noisy, variance))


@pytest.mark.parametrize("shape", [(4, 16, 16), (1, 3, 16, 16), (1, 4, 1, 16)])
def test_wrong_shapes_are_named_in_one_line(make: Make, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"takes \(B, 4, h >= 2, w >= 2\), got") as error:
        make()(*pair(*shape))
    assert "\n" not in str(error.value)


def test_weights_come_from_the_seed_and_leave_the_global_generator_alone(make: Make) -> None:
    before = torch.get_rng_state()
    first, again, other = (make(seed=seed).state_dict() for seed in (1, 1, 2))
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


def test_every_weight_learns_within_three_steps(make: Make) -> None:
    noisy, variance = pair(2, 4, 32, 32)
    model = make().train()
    before = {key: value.clone() for key, value in model.named_parameters()}
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    for _ in range(3):  # what lies before a zero weight moves one step after it, and before two zeros two steps
        optimizer.zero_grad()
        (model(noisy, variance) - 0.3).abs().mean().backward()
        optimizer.step()
    assert [key for key, value in model.named_parameters() if torch.equal(value, before[key])] == []


def test_channels_last_and_bf16_agree_with_the_plain_run(make: Make) -> None:
    noisy, variance = pair(2, 4, 32, 48)
    model = awake(make())
    plain = model(noisy, variance)
    last = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    inputs = [image.contiguous(memory_format=torch.channels_last) for image in (noisy, variance)]
    torch.testing.assert_close(last(*inputs), plain, rtol=1e-4, atol=1e-4)
    with torch.autocast("cpu", torch.bfloat16):
        half = last(*inputs)
    assert half.dtype == torch.float32  # the sum with the noisy picture stays exact
    correction = (plain - noisy).abs().mean()
    assert (half - plain).abs().mean() < 0.05 * correction


def test_an_exported_program_of_free_sides_is_saved_and_gives_the_same_numbers() -> None:
    model, (noisy, variance), file = awake(UNet(width=4, scales=3)), pair(1, 4, 32, 48), io.BytesIO()
    height, width = (4 * torch.export.Dim(name, min=2, max=512) for name in ("h", "w"))
    sizes = {2: height, 3: width}
    torch.export.save(torch.export.export(model, (noisy, variance), dynamic_shapes=(sizes, sizes)), file)
    loaded, larger = torch.export.load(file).module(), pair(1, 4, 64, 20)
    torch.testing.assert_close(loaded(*larger), model(*larger))


def test_padding_reflects_without_the_edge_as_often_as_needed() -> None:
    row = torch.tensor([[[[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]]])
    padded = pad_to_multiple(row, 8)
    assert padded[0, 0, 0].tolist() == [0, 1, 2, 1, 0, 1, 2, 1]
    assert padded[0, 0, :, 0].tolist() == [0, 3, 0, 3, 0, 3, 0, 3]
    assert pad_to_multiple(padded, 8) is padded


@pytest.mark.parametrize("domain", ["ksigma", "anscombe"])
def test_every_network_works_in_every_domain(make: Make, domain: str) -> None:
    noisy = pair(2, 4, 20, 24)[0]
    variance = 1e-3 * noisy.clamp_min(0.0) + 1e-5
    blind = make(domain=domain, variance_map=False)
    assert blind.config["domain"] == domain
    torch.testing.assert_close(blind.eval()(noisy, variance), noisy, rtol=0, atol=1e-5)
    model = awake(blind)
    assert (model(noisy, variance) - noisy).abs().max() > 1e-3
    with pytest.raises(ValueError, match=f"domain='{domain}'.*variance"):
        model(noisy)
    # The same picture at twice the gain is the same problem, whose solution is twice as bright.
    torch.testing.assert_close(model(2 * noisy, 4 * variance), 2 * model(noisy, variance), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="'log'"):
        make(domain="log")


@torch.no_grad()
def test_drunet_s_correction_does_not_depend_on_brightness_away_from_the_limits() -> None:
    """Nor, having no biases, is it limited to the size of the errors that it was trained on."""
    net = awake(DRUNet(width=4, scales=3, blocks=1, variance_map=False, domain="ksigma")).double()
    signal = torch.randn(1, 4, 32, 32, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(net.residual(signal + 100.0), net.residual(signal))
    torch.testing.assert_close(net.residual(7.0 * signal), 7.0 * net.residual(signal))
    blind = awake(DRUNet(width=4, scales=3, blocks=1, variance_map=False)).double()
    assert (blind.residual(signal + 100.0) - blind.residual(signal)).std() > 0.1, "its noise may grow with the light"


@torch.no_grad()
def test_drunet_of_patches_keeps_every_pixel_in_its_place() -> None:
    net = awake(DRUNet(width=4, scales=2, blocks=1, channels=3, variance_map=False, patch=2)).double()
    picture = torch.randn(1, 3, 96, 95, generator=torch.Generator().manual_seed(0)).double()
    correction = net(picture) - picture
    moved = F.pad(picture, (16, 0, 16, 0), mode="reflect")
    torch.testing.assert_close((net(moved) - moved)[..., 48:80, 48:80], correction[..., 32:64, 32:64])


@torch.no_grad()
def test_drunet_sees_noise_of_every_size() -> None:
    """Through the last scale also what is the same in a whole cell."""
    net = awake(DRUNet(width=4, scales=3, blocks=1, variance_map=False)).double()
    cells = torch.randn(1, 4, 16, 16, generator=torch.Generator().manual_seed(0)).double()
    correction = F.avg_pool2d(net.residual(F.interpolate(cells, scale_factor=4)), 4)
    net.get_parameter("coarse.weight").zero_()
    assert (correction - F.avg_pool2d(net.residual(F.interpolate(cells, scale_factor=4)), 4)).std() > 0.1


@torch.no_grad()
def test_limits_tell_a_network_where_the_sensor_clips() -> None:
    net = awake(DRUNet(width=4, scales=3, blocks=1, variance_map=False, domain="anscombe", limits=True))
    seen: list[Tensor] = []
    net.get_submodule("head").register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    noisy = torch.tensor([0.0, 0.5, 0.97, 1.0]).repeat_interleave(16).expand(1, 4, 64, 64)
    net(noisy, 1e-3 * noisy)
    black, white = (maps[0, 0, 0, ::16].tolist() for maps in (seen[0][:, 4:8], seen[0][:, 8:]))
    assert black == pytest.approx([2 * 0.375**0.5, 8, 8, 8], abs=0.01)
    assert white == pytest.approx([8, 8, 2 * (1000.375**0.5 - 970.375**0.5), 0], abs=0.01)
    with pytest.raises(ValueError, match="transformed"):
        DRUNet(limits=True)


def test_single_defects_are_mended_and_nothing_else() -> None:
    ramp = torch.linspace(10.0, 60.0, 64).expand(1, 4, 64, 64)
    signal = ramp + torch.randn(1, 4, 64, 64, generator=torch.Generator().manual_seed(0))
    assert torch.equal(mend_planes(signal), signal), "noise is none"
    faulty = signal.clone()
    faulty[0, 0, 20, 30], faulty[0, 3, 40, 50], faulty[0, 1, 0, 0] = 90.0, 1.2, 60.0  # hot, dead, in a corner
    torch.testing.assert_close(mend_planes(faulty), signal, rtol=0, atol=5.0)
    assert (mend_planes(faulty) != faulty).sum() == 3
    scene = signal.clone()
    scene[0, :, 20, 30] += torch.tensor([30.0, 50.0, 45.0, 25.0])  # a star, in all colours
    scene[..., 40] += 40.0  # a line
    assert torch.equal(mend_planes(scene), scene)


@pytest.mark.parametrize(("row", "column"), [(31, 31), (31.5, 31.5), (30.5, 30.5), (32, 31), (31.3, 31.7)])
@pytest.mark.parametrize("spread", [0.5, 0.8])
def test_a_point_of_light_is_no_defect_wherever_it_falls(row: float, column: float, spread: float) -> None:
    """On a sampled Gaussian of FWHM 1.2 pixels, the pixels beside the peak hold 14 % of it."""
    places = torch.arange(64.0)
    light = torch.exp(
        -(places - row)[:, None].square() / (2 * spread**2) - (places - column).square() / (2 * spread**2)
    )
    photons = bayer.pack(100.0 + 5000.0 * light[None, None], "RGGB")
    noise = torch.randn(photons.shape, generator=torch.Generator().manual_seed(0))
    signal = 2.0 * photons.sqrt() + noise
    assert torch.equal(mend_planes(signal), signal)


@torch.no_grad()
def test_what_is_mended_does_not_depend_on_the_tile() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = 50.0 + torch.randn(1, 4, 128, 400, generator=generator)
    signal[0, 1, 60, 100] = signal[0, 2, 61, 230] = 200.0
    texture = torch.rand(1, 4, 128, 150, generator=generator) ** 6 * 400.0
    signal[..., 250:] += texture

    whole = mend_planes(signal)
    assert whole[0, 1, 60, 100] < 60.0
    assert whole[0, 2, 61, 230] > 190.0, "it is beside the texture"
    part = mend_planes(signal[..., 20:240])
    assert torch.equal(part[..., 40:-40], whole[..., 60:200])


def test_a_network_that_mends_is_not_moved_by_hot_pixels() -> None:
    net = awake(DRUNet(width=4, scales=3, blocks=1, variance_map=False, domain="anscombe", mend=True))
    noisy = pair(1, 4, 32, 32)[0].clamp_min(0.0) * 0.1
    hot = noisy.clone()
    hot[0, 2, 10, 11] = 0.9
    variance = 1e-3 * noisy + 1e-5
    changed = net(hot, 1e-3 * hot + 1e-5) - net(noisy, variance)
    assert changed.abs().max() < 0.1
    assert denoisers.build("DRUNet", **net.config).config == net.config
    with pytest.raises(ValueError, match="compares"):
        DRUNet(domain="anscombe", mend=True, channels=3)


@torch.no_grad()
def test_dhdn_s_lowest_level_and_what_it_started_from_go_up_together() -> None:
    """Concatenated as at every other level: C features that were kept beside C that were worked on."""
    net = awake(DHDN(width=4))
    seen: dict[str, Tensor] = {}
    lowest, up = net.get_submodule("encoder")[-1], net.get_submodule("up")[0]  # type: ignore[index]
    lowest.register_forward_hook(lambda _, given, made: seen.update(started=given[0], worked=made))
    up.register_forward_pre_hook(lambda _, given: seen.update(up=given[0]))
    net(*pair(1, 4, 16, 16))
    assert not torch.equal(seen["started"], seen["worked"])
    assert torch.equal(seen["up"], torch.cat([seen["worked"], seen["started"]], dim=1))


@pytest.mark.parametrize("domain", ["linear", "ksigma", "anscombe"])
@pytest.mark.parametrize("name", ["PMRID", "DRUNet", "JointDRUNet"])
def test_a_config_builds_the_same_network_again(name: str, domain: str) -> None:
    """Also in a domain that is another than the network's default."""
    size: dict[str, Any] = (
        {"width": 4} if name == "PMRID" else {"width": 4, "scales": 2, "limits": False, "mend": False}
    )
    with torch.device("meta"):
        net = denoisers.build(name, domain=domain, **size)
        again = denoisers.build(name, **net.config)
    assert again.domain == domain
    assert again.config == net.config


def size(model: Denoiser) -> int:
    return sum(weight.numel() for weight in model.parameters())


def test_the_published_sizes() -> None:
    plain: dict[str, Any] = {"channels": 3, "variance_map": False}
    with torch.device("meta"):
        assert size(PMRID()) == 1_031_908
        assert size(DHDN(width=128, **plain)) == pytest.approx(168.2e6, abs=0.1e6)
        denoising = NAFNet(**plain)
        deblurring = NAFNet(width=32, encoder=(1, 1, 1, 28), middle=1, decoder=(1, 1, 1, 1), **plain)
    assert size(denoising) == pytest.approx(29.16e6, abs=0.005e6)
    assert size(deblurring) == pytest.approx(17.11e6, abs=0.005e6)


def test_pmrid_s_signals_keep_their_size_whatever_the_picture_s() -> None:
    model = PMRID(variance_map=True)
    seen: list[Tensor] = []
    for stage in (model.get_submodule("enc4"), model.get_submodule("out0")):
        stage.register_forward_hook(lambda module, inputs, output: seen.append(output))
    for side in (64, 256):  # packed pixels: a training crop's, and the first on which deep layers see no border
        noise = torch.randn(1, 8, side, side, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            model.residual(3.0 + noise)
    deviations = [output.std().item() for output in seen]
    assert 1e-3 < min(deviations) < max(deviations) < 20.0
    assert deviations[2] < 2.5 * deviations[0] and deviations[3] < 2.5 * deviations[1]


def test_pmrid_s_published_weights_denoise(camera_files: Path) -> None:
    from safetensors.torch import load_file

    from rawaug.data import open_pairs
    from rawaug.evaluation.trials import make_trial
    from rawaug.metrics import psnr
    from rawaug.noise import noise_model

    weights = camera_files.parent / "baselines/pmrid.safetensors"
    if not weights.is_file():
        pytest.skip(f"no published weights in {weights}")
    model = PMRID().eval()
    model.load_state_dict(load_file(weights))
    frame = open_pairs(str(camera_files / "raw/canon"))[0].middle(256)
    sample = make_trial(frame, noise_model("cycleisp_sidd"))
    with torch.no_grad():
        denoised = model(sample.noisy, sample.variance)
    assert psnr(denoised, sample.clean).item() > psnr(sample.noisy, sample.clean).item() + 10.0


def test_unet_has_the_published_features() -> None:
    with torch.device("meta"):
        model = UNet()
    assert model.last.in_channels == 32
    shapes = [tuple(weight.shape[:2]) for key, weight in model.named_parameters() if key.endswith(".0.weight")]
    assert shapes[:5] == [(32, 8), (64, 32), (128, 64), (256, 128), (512, 256)]
    assert shapes[5:] == [(256, 768), (128, 384), (64, 192), (32, 96)]
    assert sum(isinstance(layer, torch.nn.Conv2d) for layer in model.modules()) == 9 * 3 + 1
    assert model.stride == 16


@pytest.mark.parametrize(
    ("make_bad", "message"),
    [
        (lambda: UNet(width=0), "positive multiple of 1"),
        (lambda: DHDN(width=5), "positive multiple of 2"),
        (lambda: UNet(scales=0), r"scales .*1 to 12"),
        (lambda: DnCNN(depth=1), r"depth .*2"),
        (lambda: NAFNet(encoder=(1,), decoder=(1, 1)), "scales"),
    ],
)
def test_impossible_settings_are_refused(make_bad: Make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_bad()


def published(model: CycleISPDenoiser) -> dict[str, Tensor]:
    """The keys of a published checkpoint for weights that are all drawn anew."""
    generator, state = torch.Generator().manual_seed(1), {}
    renamed = (("head.", "head.0."), (".spatial.", ".SA.spatial.conv."), (".channel.", ".CA.conv_du."))
    for key, value in model.trunk.state_dict().items():
        for own, theirs in (*renamed, (".merge.", ".conv1x1.")):
            key = key.replace(own, theirs)
        state[f"module.{key}"] = 0.05 * torch.randn(value.shape, generator=generator)
    slope = torch.rand(64, generator=generator)  # one PReLU, saved wherever it is used
    return {key: slope if value.shape == (64,) and ".weight" in key else value for key, value in state.items()}


def test_the_published_network_has_2_8_million_parameters_and_loads(tmp_path: Path) -> None:
    model = CycleISPDenoiser()
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(2.84e6, rel=0.01)
    state = published(model)
    assert "module.body.3.body.7.CA.conv_du.2.bias" in state and "module.tail.0.bias" in state
    torch.save({"epoch": 1, "state_dict": state}, tmp_path / "sidd.pth")
    loaded = CycleISPDenoiser.from_published(tmp_path / "sidd.pth")
    assert torch.equal(loaded.trunk.head.weight, state["module.head.0.weight"])
    assert torch.equal(
        loaded.trunk.get_parameter("body.0.body.0.merge.bias"), state["module.body.0.body.0.conv1x1.bias"]
    )
    noisy, variance = torch.rand(1, 4, 6, 8), torch.full((1, 4, 6, 8), 1e-3)
    with torch.no_grad():
        given = torch.cat([noisy, variance], dim=1)  # the variance itself, not its root
        expected = noisy + loaded.trunk.tail(loaded.trunk.body(loaded.trunk.head(given)))  # type: ignore[operator]
        torch.testing.assert_close(loaded(noisy, variance), expected)
        assert not torch.equal(expected, noisy)
    denoisers.save(loaded, tmp_path / "own.safetensors", {})
    again, _ = denoisers.load(tmp_path / "own.safetensors")
    with torch.no_grad():
        torch.testing.assert_close(again(noisy, variance), loaded(noisy, variance))


class Payload:
    """What a pickle could carry."""


def test_other_checkpoints_are_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {"head": Payload()}}, tmp_path / "code.pth")
    with pytest.raises(ValueError, match="checkpoint"):
        CycleISPDenoiser.from_published(tmp_path / "code.pth")
    torch.save({"state_dict": {"head.0.bias": torch.zeros(64)}}, tmp_path / "part.pth")
    with pytest.raises(ValueError, match=r"part\.pth: .*denoiser"):
        CycleISPDenoiser.from_published(tmp_path / "part.pth")
    with pytest.raises(ValueError, match="reduction"):
        CycleISPDenoiser(groups=0)


@pytest.mark.parametrize("name", ["UNet", "DHDN", "DnCNN"])
def test_onnx_gives_the_same_numbers(name: str, tmp_path: Path) -> None:
    for library in ("onnx", "onnxruntime"):
        pytest.importorskip(library, reason="pip install rawaug[export]")
    from onnxruntime import InferenceSession

    model, (noisy, variance) = awake(SMALL[name]()), pair(1, 4, 30, 45)  # padded inside
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own
        torch.onnx.export(
            model, (noisy, variance), str(tmp_path / "a.onnx"), dynamo=False, input_names=["noisy", "variance"]
        )
    session = InferenceSession(tmp_path / "a.onnx", providers=["CPUExecutionProvider"])
    flat = [(torch.full_like(noisy, level), torch.zeros_like(noisy)) for level in (0.5, 1.0)]  # bright, without noise
    for given in ((noisy, variance), *flat):
        (denoised,) = session.run(None, {"noisy": given[0].numpy(), "variance": given[1].numpy()})
        with torch.no_grad():
            expected = model(*given).numpy()
        np.testing.assert_allclose(denoised, expected, rtol=1e-4, atol=1e-5)
        assert np.abs(expected).max() > 0.1
    assert not np.allclose(model(noisy, variance).detach(), noisy, atol=1e-3)


class Mean(Denoiser):
    """The mean over 3 x 3 pixels: what is wider than these it leaves."""

    def __init__(self, channels: int, pyramid: int) -> None:
        super().__init__({}, pyramid=pyramid, channels=channels, variance_map=False)

    def residual(self, features: Tensor) -> Tensor:
        padded = F.pad(features, (1, 1, 1, 1), mode="reflect")
        return F.avg_pool2d(padded, 3, 1) - features


@pytest.mark.parametrize("channels", [3, 4])
def test_a_pyramid_takes_out_wide_noise_and_leaves_the_scene(channels: int) -> None:
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(112.0), indexing="ij")
    scene = torch.stack([0.004 * (rows + i / 2) + 0.003 * (columns + j / 2) for i in (0, 1) for j in (0, 1)])[None]
    scene = scene[:, :channels] if channels == 4 else scene[:, :1].expand(1, 3, 96, 112)
    models = [Mean(channels, halvings) for halvings in range(3)]
    torch.testing.assert_close(models[2](scene)[..., 16:-16, 16:-16], scene[..., 16:-16, 16:-16])
    noise = 0.01 * torch.randn(scene.shape, generator=torch.Generator().manual_seed(0))
    errors = [(model(scene + noise) - scene)[..., 16:-16, 16:-16] for model in models]
    wide = [F.avg_pool2d(error, 8).square().mean() for error in errors]
    assert wide[1] < 0.9 * wide[0] and wide[2] < 0.9 * wide[1]
    assert errors[1].square().mean() < 0.95 * errors[0].square().mean()
    assert models[2](noise[..., :2, :3]).shape == (1, channels, 2, 3)


@torch.no_grad()
@pytest.mark.parametrize("channels", [3, 4])
def test_a_pyramid_is_told_the_variance_that_is_left_at_every_scale(channels: int) -> None:
    seen: list[tuple[float, float]] = []

    class Told(Denoiser):
        def __init__(self) -> None:
            super().__init__({}, pyramid=2, channels=channels, deviation=False)

        def residual(self, features: Tensor) -> Tensor:
            picture, variance = (x[..., 4:-4, 4:-4] for x in features.split(channels, dim=1))
            seen.append((picture.var().item(), variance.mean().item()))
            return torch.zeros_like(features[:, :channels])

    noise = 0.05 * torch.randn(1, channels, 512, 512, generator=torch.Generator().manual_seed(0))
    Told()(0.4 + noise, torch.full_like(noise, 0.05**2))
    assert len(seen) == 3
    for measured, told in seen:
        assert told == pytest.approx(measured, rel=0.3)  # binned packed RAW is a little correlated


@torch.no_grad()
def test_a_pyramid_asks_nothing_of_clipped_values() -> None:
    bright = 1.1 + 0.1 * torch.randn((1, 4, 64, 64), generator=torch.Generator().manual_seed(0))
    bright[..., 32:] -= 0.6
    plain, pyramid = (Mean(4, halvings)(bright.clamp_max(1.0)) for halvings in (0, 2))
    torch.testing.assert_close(pyramid[..., :20], plain[..., :20], rtol=0.0, atol=0.0)
    assert (pyramid[..., 44:] - plain[..., 44:]).std() > 0.003


@torch.no_grad()
def test_a_pyramid_is_built_again_and_a_defect_stays_small() -> None:
    settings: dict[str, Any] = {"width": 4, "scales": 2, "blocks": 1, "variance_map": False, "domain": "anscombe"}
    net = awake(DRUNet(**settings, mend=True, pyramid=2))
    assert net.stride == 4 * awake(DRUNet(**settings)).stride
    assert denoisers.build("DRUNet", **net.config).pyramid == 2
    noisy = pair(1, 4, 32, 32)[0].clamp_min(0.0) * 0.1
    hot = noisy.clone()
    hot[0, 2, 10, 11] = 0.9
    changed = net(hot, 1e-3 * hot + 1e-5) - net(noisy, 1e-3 * noisy + 1e-5)
    assert changed.abs().max() < 0.1


def test_a_fused_block_gives_what_its_layers_give_one_by_one() -> None:
    block = ResidualBlock(8).eval()
    generator = torch.Generator().manual_seed(0)
    for layer in (block.conv1, block.conv2):
        layer.weight.data.normal_(0.0, 0.1, generator=generator)
    features = torch.randn(2, 8, 20, 24, generator=generator)
    expected = features + block.conv2(block.conv1(features).relu())

    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        for layout in (torch.contiguous_format, torch.channels_last):
            given = features.bfloat16().to(memory_format=layout)
            assert can_fuse(given)
            kept = given.clone()
            assert (block(given).float() - expected).abs().max() < 0.02 * expected.abs().max()
            assert torch.equal(given, kept)


def test_layers_are_not_fused_where_gradients_or_other_types_are_wanted() -> None:
    features = torch.rand(1, 8, 16, 16)
    assert not can_fuse(features.bfloat16())
    with torch.no_grad():
        assert not can_fuse(features)
        assert not can_fuse(features.bfloat16().to("meta"))
