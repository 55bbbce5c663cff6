"""Cameras are found by the names that people have for them, and listed with what is known of each."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from rawaug.camera.matrices import load_cameras
from rawaug.camera.names import camera_key, find_camera, similar_cameras
from rawaug.cli import main
from rawaug.noise import noise_levels
from rawaug.noise.profiles import load_profiles

MATRICES, PROFILES = load_cameras().names, load_profiles().names


@pytest.mark.parametrize(
    ("said", "listed"),
    [
        ("Sony A7 III", "Sony ILCE-7M3"),
        ("sony \u03b17R IV", "Sony ILCE-7RM4"),
        ("Sony A7III", "Sony ILCE-7M3"),
        ("Sony A7", "Sony ILCE-7"),
        ("Sony alpha 6400", "Sony ILCE-6400"),
        ("Sony A77 II", "Sony ILCA-77M2"),
        ("Sony A77", "Sony SLT-A77"),
        ("Sony RX100 VA", "Sony DSC-RX100M5A"),
        ("Canon Rebel T5i", "Canon EOS 700D"),
        ("Canon EOS Kiss X6i", "Canon EOS 650D"),
        ("Canon 5D Mk3", "Canon EOS 5D Mark III"),
        ("Nikon Z7 II", "Nikon Z 7_2"),
        ("Panasonic Lumix GH5", "Panasonic DC-GH5"),
        ("Fujifilm XT3", "Fujifilm X-T3"),
        ("NIKON CORPORATION NIKON D5000", "Nikon D5000"),
        ("OLYMPUS IMAGING CORP. E-PL5", "Olympus E-PL5"),
        ("Canon Canon EOS 5D Mark II", "Canon EOS 5D Mark II"),
    ],
)
def test_marketing_names_are_those_of_the_files(said: str, listed: str) -> None:
    assert find_camera(said, MATRICES) == find_camera(said, PROFILES) == listed


def test_no_two_cameras_share_a_key() -> None:
    """But for spellings of one camera, and LibRaw's beginnings of names, such as SLT-A5."""
    beginnings = {"Sony ILCE-", "Sony SLT-A", "Sony DSLR-A", "Sony SLT-A5", "Sony DSLR-A5"}
    plain: dict[str, set[str]] = {}
    for name in {*MATRICES, *PROFILES} - beginnings:
        letters = "".join(c for c in name.casefold().replace("mark ii", "ii").replace("markii", "ii") if c.isalnum())
        plain.setdefault(camera_key(name), set()).add(letters)
    assert not {key: names for key, names in plain.items() if len(names) > 1}


def test_names_as_they_are_listed_come_first() -> None:
    assert all(find_camera(name, MATRICES).casefold() == name.casefold() for name in MATRICES)


def test_an_unknown_camera_is_compared_by_its_words() -> None:
    with pytest.raises(ValueError, match=r"similar: .*ILCE"):
        find_camera("A7 III", MATRICES)
    with pytest.raises(ValueError, match="camera"):
        find_camera("iPhone 12", MATRICES)
    with pytest.raises(ValueError, match="similar: Nikon D750,"):
        noise_levels("Nikon D75O")
    assert similar_cameras("mark iii canon 5d", PROFILES) == ["Canon EOS 5D Mark III"]


def test_the_list_says_what_is_known_of_each(capsys: pytest.CaptureFixture[str], refused: Callable[..., str]) -> None:
    assert main(["info", "cameras", "A7", "III"]) == 0
    head, row, *levels = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["camera", "matrix"] and row.split("  ")[0] == "Sony ILCE-7M3"
    assert row.split()[2:] == ["yes", "100", "to", "102400"]
    assert len(levels) == 11 and levels[0].split()[:6] == ["ISO", "100", "shot_var", "8.35e-06", "to", "1.59e-05"]
    assert main(["info", "cameras", "Nikon D850", "--json"]) == 0
    (camera,) = json.loads(capsys.readouterr().out)["cameras"]
    assert camera["noise"][0][0] == camera["iso"][0] and all(
        low < high for _, *ends in camera["noise"] for low, high in ends
    )
    index = MATRICES.index("Nikon D850")
    assert camera["xyz_to_camera"] == load_cameras().xyz_to_camera[index].tolist()
    assert main(["info", "cameras"]) == 0
    everything = capsys.readouterr().out
    assert {"Google Pixel", "SonyA7S2"} <= {line.split("  ")[0] for line in everything.splitlines()}
    assert "no camera has 'zork' in its name" in refused("info", "cameras", "zork")
    assert "too many arguments" in refused("info", "universal", "zork")
