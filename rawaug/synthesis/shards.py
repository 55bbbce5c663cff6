"""RAW pairs in tar shards, as WebDataset and Hugging Face read them.

With n pictures in a shard, ``shard-000012.tar`` has the pairs of pictures 12 n to 12 n + n - 1 of the sorted folder. A
sample is three files with one key, ``PICTURE_NUMBER``: ``KEY.clean.npy`` and ``KEY.noisy.npy``, float32 as in
:class:`rawaug.RawPair`, and ``KEY.json`` with picture and ISP and their SHA-256, CFA, the mosaic's height and width,
noise levels and parameters.

The bytes of a shard depend only on its pictures and the settings. ``.shards/shard-000012.json`` is written last. A
shard is complete if it has the size that is stated there, and its pictures are those of which it was made. Once all
shards are complete, ``index.json`` (sizes, as WebDataset's ``wids`` reads them) and the dataset card ``README.md`` are
written.
"""

from __future__ import annotations

import io
import json
import os
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.files import cached, digest, read_keyed_json, replacing, sha256, write_json, write_text
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.targets import Burst
from rawaug.synthesis.files import Origin, Settings, Synthesiser, pair_levels, replay_pair

PER_SHARD = 500
"""Default number of pictures in a shard, which has two gigabytes if they have half a megapixel each."""

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))


class ShardJob:
    """One shard.

    Args:
        path: path of its tar file.
        first: index of its first picture in the sorted folder.
        source: the folder of the pictures.
        names: names of its pictures within this folder.
        per_image: number of pairs of each picture.
    """

    def __init__(self, path: Path, first: int, source: Path, names: Sequence[str], per_image: int) -> None:
        self.path = path
        self.first = first
        self.source = source
        self.names = names
        self.per_image = per_image

        self.pictures = len(names)

    def make(self, maker: Synthesiser) -> tuple[int, int, dict[str, str]]:
        """Write the shard unless it is there, whole and of the same pictures.

        Returns:
            The number of pairs that were made, the number of those that were there, and the reason for each picture
            that cannot be read.
        """
        made = 0

        def write() -> dict[str, Any]:
            nonlocal made
            broken: dict[str, str] = {}
            with replacing(self.path) as partial, tarfile.open(partial, "w", format=tarfile.USTAR_FORMAT) as tar:
                for index, name in enumerate(self.names, self.first):
                    picture = self.source / name
                    try:
                        origin, pairs = maker.pairs(picture, name, range(self.per_image))
                    except (OSError, ValueError) as error:
                        broken[name] = str(error).replace(str(picture), name)
                        continue
                    for number, pair in pairs:
                        _add_sample(tar, f"{index:08d}_{number}", pair, _describe(pair, maker, origin, name, number))
                        made += 1

            size = self.path.stat().st_size
            return {"url": self.path.name, "nsamples": made, "filesize": size, "broken": broken}

        record = cached(_record_path(self.path), self._hash_pictures(), write, _read_record)
        return made, record["nsamples"] - made, record["broken"]

    def _hash_pictures(self) -> list[str]:
        """Hash the pictures; those that cannot be read have no hash."""
        hashes = []
        for name in self.names:
            try:
                hashes.append(sha256(self.source / name))
            except OSError:
                hashes.append("")
        return hashes


def _shard_path(out: Path, number: int) -> Path:
    return out / f"shard-{number:06d}.tar"


def _record_path(shard: Path) -> Path:
    return shard.parent / ".shards" / f"{shard.stem}.json"


def _read_record(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the record of a shard, and apart from it its key; both are empty if the shard has another size, or none."""
    shard = file.parents[1] / f"{file.stem}.tar"
    if not file.is_file() or not shard.is_file():
        return {}, {}

    record, info = read_keyed_json(file)
    if record.get("filesize") != shard.stat().st_size:
        return {}, {}
    return record, info


def shard_jobs(
    pictures: Sequence[Path], source: Path, out: Path, per_image: int, per_shard: int = PER_SHARD
) -> list[ShardJob]:
    """Divide pictures into shards.

    Args:
        pictures: sRGB files below ``source``, sorted.
        source: the folder of the pictures.
        out: the folder of the shards.
        per_image: number of pairs of each picture.
        per_shard: number of pictures in each shard but the last.
    """
    if per_shard < 1:
        raise ValueError(f"per_shard must be at least 1, got {per_shard}")

    names = _names(pictures, source)
    jobs = []
    for number, first in enumerate(range(0, len(names), per_shard)):
        shard = _shard_path(out, number)
        jobs.append(ShardJob(shard, first, source, names[first : first + per_shard], per_image))
    return jobs


def shard_settings(
    pictures: Sequence[Path], source: Path, per_image: int, per_shard: int, max_pixels: int
) -> dict[str, object]:
    """Get the settings that must not change between runs: adding a picture would shift all later shards.

    Args:
        pictures: sRGB files below ``source``, sorted.
        source: the folder of the pictures.
        per_image: number of pairs of each picture.
        per_shard: number of pictures in each shard.
        max_pixels: number of pixels of the largest picture that is read.
    """
    return {
        "pictures": len(pictures),
        "names_sha256": digest(os.fsencode("\n".join(_names(pictures, source)))),  # names need not be UTF-8
        "per_image": per_image,
        "per_shard": per_shard,
        "max_pixels": max_pixels,
    }


def _names(pictures: Sequence[Path], source: Path) -> tuple[str, ...]:
    return tuple(picture.relative_to(source).as_posix() for picture in pictures)


def _describe(pair: RawPair, maker: Synthesiser, origin: Origin, name: str, number: int) -> dict[str, Any]:
    """Describe a sample as JSON; paths are relative, so that machines with other folders write the same bytes."""
    sample = asdict(origin) | {"picture": name, "number": number, "cfa": maker.augment.cfa}
    sample["settings"]["isp"] = Path(sample["settings"]["isp"]).name

    image = pair.clean
    if len(image) != 3:
        image = maker.augment.mosaic(image)
    height, width = image.shape[-2:]
    params = {key: value.tolist() for key, value in pair.params.tensors().items()}
    return sample | pair_levels(pair) | {"height": height, "width": width, "params": params}


def _add_sample(tar: tarfile.TarFile, key: str, pair: RawPair, sample: Mapping[str, Any]) -> None:
    contents = {
        "clean.npy": _npy(pair.clean),
        "json": json.dumps(sample, sort_keys=True).encode(),
        "noisy.npy": _npy(pair.noisy),
    }
    for ending, content in contents.items():
        entry = tarfile.TarInfo(f"{key}.{ending}")  # it has no owner, and its time is the epoch
        entry.size = len(content)
        tar.addfile(entry, io.BytesIO(content))


def _npy(tensor: Tensor) -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array(content, tensor.contiguous().numpy(), allow_pickle=False)
    return content.getvalue()


def replay_sample(sample: Mapping[str, Any], pictures: str | Path, isp: str | Path | None = None) -> RawPair:
    """Make the pair ``(4, h, w)`` of a sample again from its JSON, bit for bit as in its shard.

    Args:
        sample: the sample's JSON.
        pictures: the folder that the shards were made from.
        isp: the ISP's file, unless it is a shipped one.

    Raises:
        ValueError: if the picture or the ISP has changed.
    """
    tensors = {key: torch.tensor(value) for key, value in sample["params"].items()}
    params = AugmentParams.from_tensors(tensors)
    origin = Origin(**{field.name: sample[field.name] for field in fields(Origin) if field.name in sample})
    picture = Path(pictures) / sample["picture"]
    return replay_pair(params, origin, sample["picture"], picture, isp)


def write_index(out: Path, count: int, settings: Settings) -> None:
    """Write the index and the dataset card once all shards exist."""
    shards = []
    for number in range(count):
        record, _ = _read_record(_record_path(_shard_path(out, number)))
        if not record:
            return
        shards.append({"url": record["url"], "nsamples": record["nsamples"], "filesize": record["filesize"]})
    index = {"__kind__": "wids-shard-index-v1", "wids_version": 1, "name": "rawaug pairs", "shardlist": shards}
    write_json(index, out / "index.json")
    write_text(_dataset_card(shards, settings), out / "README.md")


def _dataset_card(shards: Sequence[Mapping[str, Any]], settings: Settings) -> str:
    """Write the text of the dataset card, with the header that Hugging Face reads."""
    from jinja2 import Environment, PackageLoader

    pairs = sum(shard["nsamples"] for shard in shards)
    size = sum(shard["filesize"] for shard in shards)
    config = settings.config

    rows = settings.to_json()
    rows["isp"] = f"{Path(config.isp).name} (SHA-256 {rows.pop('isp_sha256')})"
    del rows["format"]
    other_pattern = config.cfa
    if config.cfa in CFA.__members__:
        other_pattern = None
    frames = config.burst
    if isinstance(frames, Burst):
        frames = frames.frames

    templates = Environment(loader=PackageLoader(__package__, ""), trim_blocks=True, keep_trailing_newline=True)
    return templates.get_template("card.md").render(
        category=_size_category(pairs),
        pairs=pairs,
        shards=len(shards),
        gigabytes=f"{size / 1e9:.3g}",
        rows=rows,
        target=config.target_name,
        cfa=other_pattern,
        frames=frames,
    )


def _size_category(pairs: int) -> str:
    for limit, name in _SIZES:
        if pairs < limit:
            return name
    return "n>10M"
