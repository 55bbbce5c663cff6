"""Files of weights give the same network back; anything else is refused in one line; shipped ones have a card."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from denoisers import DENOISERS, UNet, build, from_pretrained, load, save
from denoisers import files as pretrained

SMALL: list[tuple[str, dict[str, Any]]] = [
    ("UNet", {"width": 4, "scales": 3, "variance_map": False}),
    ("DHDN", {"width": 4, "deviation": False}),
    ("DnCNN", {"width": 8, "depth": 3, "batch_norm": True, "channels": 3}),
]


@pytest.mark.parametrize(("name", "config"), SMALL)
def test_round_trip(name: str, config: dict[str, Any], tmp_path: Path) -> None:
    model = build(name, seed=4, **config)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.01)  # nothing is at its initial value
    model = model.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    path = tmp_path / "a.safetensors"
    save(model, path, {"steps": 7, "data": ["a", "b"]})
    loaded, info = load(path)
    assert type(loaded) is DENOISERS[name] and info == {"steps": 7, "data": ["a", "b"]}
    assert loaded.config == model.config and not loaded.training
    assert all(loaded.config[key] == value for key, value in config.items())
    noisy = torch.rand(1, loaded.channels, 10, 14, generator=torch.Generator().manual_seed(0))
    variance = torch.full_like(noisy, 1e-3)
    torch.testing.assert_close(loaded(noisy, variance), model(noisy, variance), rtol=1e-5, atol=1e-5)
    assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), model.parameters(), strict=True))
    loaded(noisy, variance).mean().backward()  # what was loaded can be trained on
    assert all(weight.requires_grad for weight in loaded.parameters())
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]


def test_what_cannot_be_loaded_again_is_not_saved(tmp_path: Path) -> None:
    class Mine(UNet):
        pass

    with pytest.raises(ValueError, match="cannot save a Mine"):
        save(Mine(width=4), tmp_path / "a.safetensors", {})
    with pytest.raises(ValueError, match="JSON"):
        save(UNet(width=4), tmp_path / "a.safetensors", {"tensor": torch.zeros(1)})
    with pytest.raises(FileNotFoundError, match="exist"):
        save(UNet(width=4), tmp_path / "none" / "a.safetensors", {})
    assert list(tmp_path.iterdir()) == []


GOOD = {"format": "rawaug", "kind": "denoiser", "model": "DnCNN", "config": '{"width": 4, "depth": 2}', "info": "{}"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "isp"}, "rawaug"),
        ({"model": "os.system"}, "'os.system'"),
        ({"config": "{"}, "not JSON"),
        ({"config": "[1]"}, "JSON object"),
        ({"config": '{"width": 4, "dept": 2}'}, "'dept'"),
        ({"config": '{"width": -4, "depth": 2}'}, "width"),
        ({"config": '{"width": "4", "depth": 2}'}, "width must be int"),
        ({"config": '{"width": 8, "depth": 2}'}, r"layers\.0\.bias"),
        ({"config": '{"width": 60000, "depth": 90}'}, r"DnCNN: .* weights"),
        ({"config": '{"width": 1000000000, "depth": 2}'}, r"width .*1 to 65536"),
        ({"config": '{"width": 1e29, "depth": 2}'}, "width must be int"),
        ({"config": '{"width": 4, "depth": 1000000}'}, r"depth .*0 to 1000"),
        ({"config": '{"width": 4, "depth": 2, "seed": 1' + "0" * 30 + "}"}, r"seed .*whole"),
        ({"model": "UNet", "config": '{"scales": 1000000000}'}, r"scales .*1 to 12"),
        ({"model": "NAFNet", "config": '{"encoder": [1, 9999999], "decoder": [1, 1]}'}, "encoder must be"),
        ({"model": "CycleISPDenoiser", "config": '{"groups": 500, "blocks": 500}'}, r"blocks .*whole"),
        ({"info": '{"a":' * 10000 + "1" + "}" * 10000}, "too deeply nested"),
        ({"info": '{"noise": [Infinity, 0]}'}, r"Infinity .*finite"),
        ({"info": '{"noise": [1e999, 0]}'}, r"1e999 .*finite"),
        ({"config": '{"width": 4, "depth": 3}'}, r"layers\.\S+"),
        ({"info": ""}, "not JSON"),
    ],
)
def test_bad_files_are_named_in_one_line(change: dict[str, str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.safetensors"
    tensors = build("DnCNN", **json.loads(GOOD["config"])).state_dict()
    save_file(tensors, path, metadata=GOOD)
    load(path)
    save_file(tensors, path, metadata={**GOOD, **change})
    with pytest.raises(ValueError, match=message) as error:
        load(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize("content", [b"", b"not a file of weights at all", b"\xff" * 64])
def test_other_files_and_none_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    with pytest.raises(FileNotFoundError, match=r"other\.safetensors"):
        load(path)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"other\.safetensors: .*safetensors") as error:
        load(path)
    assert "\n" not in str(error.value)


def test_build_names_what_is_unknown() -> None:
    assert build("UNet", width=4).config["width"] == 4
    with pytest.raises(ValueError, match="'Unet'"):
        build("Unet")
    with pytest.raises(ValueError, match="'depth'"):
        build("UNet", depth=3)
    with pytest.raises(ValueError, match="variance_map"):
        build("UNet", variance_map=1)


def test_weights_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    model = build("DnCNN", width=4, depth=2)
    with torch.no_grad():
        next(model.parameters())[0, 0, 0, 0] = torch.nan
    save(model, tmp_path / "a.safetensors", {})
    with pytest.raises(ValueError, match=r"a\.safetensors: .*tensor"):
        load(tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match="its numbers finite"):
        save(UNet(width=4), tmp_path / "b.safetensors", {"noise": [float("inf"), 0.0]})


FIELDS = ["For", "Licence", "Architecture", "Training data", "Command", "Commit", "Seed", "SHA-256", "Noise"]
FIELDS += ["Chosen on", "Real noise", "Not good for"]
"""Rows of the card, as the template in docs/model_card.md has them."""

ROOT = Path(__file__).parents[2]


def test_a_name_or_a_path_gives_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    model = UNet(width=4, scales=2, seed=3)
    save(model, tmp_path / "tiny.safetensors", {})
    for name in ("tiny", tmp_path / "tiny.safetensors"):
        loaded = from_pretrained(name)
        assert not loaded.training
        assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), model.parameters(), strict=True))
    with pytest.raises(FileNotFoundError, match=r"huge: .*denoiser"):
        from_pretrained("huge")


@pytest.mark.parametrize("name", pretrained.list_shipped())
def test_every_shipped_denoiser_has_its_card_and_the_template_its_fields(name: str) -> None:
    weights = pretrained.FOLDER / f"{name}.safetensors"
    card = weights.with_suffix(".md").read_text(encoding="utf-8")
    for text in (card, (ROOT / "docs/model_card.md").read_text(encoding="utf-8")):
        assert [field for field in FIELDS if f"| {field} |" not in text] == []
    assert hashlib.sha256(weights.read_bytes()).hexdigest() in card
    assert weights.stat().st_size < 6e6 or name != pretrained.DEFAULT
    assert "TODO" not in card
