"""Pairs in tar shards: the same bytes however they are made, readable by WebDataset and Hugging Face."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rawaug.files import replacing
from rawaug.io import write_picture
from rawaug.plugin.targets import Srgb
from rawaug.synthesis import shards as pair_shards
from rawaug.synthesis.folder import Synthesis, parse_shard, synth
from rawaug.synthesis.shards import replay_sample

FIXED = (2e-3, 1e-4)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven pictures in two folders, one with dots in its name, and a broken one."""
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "sub").mkdir()
    generator = torch.Generator().manual_seed(0)
    for k, name in enumerate(("a.png", "b.c.d.png", "e.png", "sub/a.png", "sub/f.png", "sub/g.png", "z.png")):
        write_picture(folder / name, torch.rand(3, 16, 16 + 2 * k, generator=generator))
    (folder / "broken.png").write_bytes((folder / "a.png").read_bytes()[:50])
    return folder


def shards(pictures: Path, out: Path, shard: str = "1/1", per_image: int = 2, seed: int = 0) -> Synthesis:
    return synth(pictures, out, "webdataset", per_image, noise=FIXED, seed=seed, workers=0, shard=shard, per_shard=3)


@pytest.fixture(scope="module")
def whole(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shards(pictures, tmp_path_factory.mktemp("whole")).out


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def samples(folder: Path) -> dict[str, dict[str, bytes]]:
    found: dict[str, dict[str, bytes]] = {}
    for path in sorted(folder.glob("shard-*.tar")):
        with tarfile.open(path) as tar:
            for entry in tar:
                key, _, ending = entry.name.partition(".")
                content = tar.extractfile(entry)
                assert content is not None and entry.mtime == 0 and entry.uid == 0
                found.setdefault(key, {})[ending] = content.read()
    return found


def test_parts_in_any_order_make_the_bytes_of_one_run(pictures: Path, whole: Path, tmp_path: Path) -> None:
    counted = [shards(pictures, tmp_path, f"{k}/2") for k in (2, 1)]
    assert [(r.pictures, r.made, list(r.broken)) for r in counted] == [(3, 6, []), (5, 8, ["broken.png"])]
    assert contents(tmp_path) == contents(whole)


def test_a_killed_run_is_resumed_by_shard(pictures: Path, whole: Path, tmp_path: Path) -> None:
    shards(pictures, tmp_path, "1/3")
    with replacing(tmp_path / "shard-000001.tar") as partial:
        partial.touch()
        abandoned = partial
    (tmp_path / "shard-000001.tar").unlink()
    abandoned.write_bytes(b"killed here")
    (tmp_path / "shard-000002.tar").write_bytes(b"killed after this was written, before its record")
    assert not (tmp_path / "README.md").exists() and not (tmp_path / "index.json").exists()
    before = (tmp_path / "shard-000000.tar").stat().st_mtime_ns
    resumed = shards(pictures, tmp_path)
    assert (resumed.pictures, resumed.existing, resumed.made) == (8, 4, 10) and list(resumed.broken) == ["broken.png"]
    assert (tmp_path / "shard-000000.tar").stat().st_mtime_ns == before
    assert contents(tmp_path) == contents(whole)
    again = shards(pictures, tmp_path)
    assert (again.made, again.existing) == (0, 14)
    assert list(again.broken) == ["broken.png"], "what a shard lacks is reported by every run"


def test_a_shard_that_is_gone_torn_or_of_other_pictures_is_made_again(
    pictures: Path, whole: Path, tmp_path: Path
) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(pictures, source)
    shards(source, out)
    (out / "shard-000000.tar").unlink()
    torn = (out / "shard-000001.tar").read_bytes()
    (out / "shard-000001.tar").write_bytes(torn[: len(torn) // 2])
    again = shards(source, out)
    assert again.made > 0 and contents(out) == contents(whole)

    write_picture(sorted(source.glob("*.png"))[0], torch.full((3, 16, 16), 90, dtype=torch.uint8))
    assert 0 < shards(source, out).made < again.made + again.existing
    assert contents(out) != contents(whole)


def test_the_pairs_are_those_of_other_formats(pictures: Path, whole: Path, tmp_path: Path) -> None:
    synth(pictures, tmp_path, "npz", 2, noise=FIXED, workers=0)
    files = samples(whole)
    assert list(files) == [f"{k:08d}_{n}" for k in (0, 1, 3, 4, 5, 6, 7) for n in (0, 1)], "sorted; 2 is broken"
    with np.load(tmp_path / "b.c.d_1.npz") as expected:
        sample = files["00000001_1"]
        for name in ("clean", "noisy"):
            assert np.array_equal(np.load(io.BytesIO(sample[f"{name}.npy"])), expected[name])
    described = json.loads(sample["json"])
    assert (described["picture"], described["number"], described["cfa"]) == ("b.c.d.png", 1, "RGGB")
    assert (described["height"], described["width"]) == (16, 18)
    replayed = replay_sample(described, pictures)
    assert np.array_equal(replayed.noisy.numpy(), np.load(io.BytesIO(sample["noisy.npy"])))
    assert described["shot_var"] == pytest.approx(FIXED[0]) and described["settings"]["isp"] == "universal"


def test_a_sample_is_replayed_only_from_its_picture(pictures: Path, whole: Path, tmp_path: Path) -> None:
    described = json.loads(samples(whole)["00000004_1"]["json"])
    (tmp_path / "sub").mkdir()
    (tmp_path / described["picture"]).write_bytes((pictures / "z.png").read_bytes())
    with pytest.raises(ValueError, match=r"sub/a\.png: .*changed"):
        replay_sample(described, tmp_path)


def test_bursts_of_developed_pictures_are_replayed(pictures: Path, tmp_path: Path) -> None:
    form: dict[str, Any] = {"target": Srgb(jpeg=(60, 90)), "burst": 2}
    synth(pictures / "z.png", tmp_path, "webdataset", noise=FIXED, workers=0, **form)
    (sample,) = samples(tmp_path).values()
    noisy, clean = (torch.from_numpy(np.load(io.BytesIO(sample[f"{name}.npy"]))) for name in ("noisy", "clean"))
    described = json.loads(sample["json"])
    pair = replay_sample(described, pictures)
    assert torch.equal(pair.noisy, noisy) and torch.equal(pair.clean, clean) and noisy.shape == (2, *clean.shape)
    assert (described["height"], described["width"]) == tuple(clean.shape[-2:])
    card = (tmp_path / "README.md").read_text()
    assert "developed sRGB, float32 `(3, H, W)`" in card and "an axis of 2 frames" in card and "| burst | 2 |" in card


def test_index_and_card_count_what_is_there(whole: Path) -> None:
    shards = json.loads((whole / "index.json").read_text())["shardlist"]
    assert [(shard["url"], shard["nsamples"]) for shard in shards] == [
        (f"shard-00000{k}.tar", n) for k, n in enumerate((4, 6, 4))
    ]
    assert all((whole / shard["url"]).stat().st_size == shard["filesize"] for shard in shards)
    assert "14 noisy/clean RAW pairs in 3 WebDataset shards" in (whole / "README.md").read_text()


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset_reads_them(whole: Path) -> None:
    wds = pytest.importorskip("webdataset", reason="pip install rawaug[test]")
    urls = [str(path) for path in sorted(whole.glob("shard-*.tar"))]
    read = list(wds.WebDataset(urls, shardshuffle=False).decode().to_tuple("__key__", "noisy.npy", "json"))
    assert [key for key, _, _ in read] == list(samples(whole))
    for _, noisy, described in read:
        assert noisy.dtype == np.float32 and noisy.shape == (4, described["height"] // 2, described["width"] // 2)


def test_hugging_face_finds_them_by_their_card(whole: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets", reason="pip install rawaug[test]")
    read = list(datasets.load_dataset(str(whole), split="train", streaming=True, cache_dir=str(tmp_path)))
    assert [row["__key__"].rpartition("/")[2] for row in read] == list(samples(whole))
    assert np.asarray(read[0]["clean.npy"], np.float32).shape == (4, 8, 8)
    assert read[3]["json"]["picture"] == "b.c.d.png"


def test_what_cannot_go_on_is_refused(pictures: Path, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"synth\.json: .*made"):
        shards(pictures, whole, seed=1)
    with pytest.raises(ValueError, match="per_image"):
        shards(pictures, whole, per_image=1)
    with pytest.raises(ValueError, match="per_shard"):
        pair_shards.shard_jobs([pictures / "a.png"], pictures, tmp_path, 1, 0)
    for shard in ("0/4", "5/4", "3", "1/0", "a/b", "-1/2", "1/2/3"):
        with pytest.raises(ValueError, match="shard"):
            parse_shard(shard)


def test_parts_of_files_are_every_nth_picture(pictures: Path, tmp_path: Path) -> None:
    counted = [synth(pictures, tmp_path, "npz", noise=FIXED, workers=0, shard=f"{k}/3") for k in (1, 2, 3)]
    assert [(r.pictures, r.made) for r in counted] == [(3, 3), (3, 3), (2, 1)]
    assert len(list(tmp_path.rglob("*.npz"))) == 7
