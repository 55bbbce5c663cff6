"""Files: written whole or not at all, hashed, and safetensors whose errors fit one line.

Weights, parameters and states are safetensors (https://huggingface.co/docs/safetensors) with texts in their header;
``format`` is ``rawaug`` and ``kind`` says what is in the file.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

WEIGHTS = Path(__file__).parent / "weights"
"""The folder of the shipped ISPs."""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path beside ``path`` to write to, which takes its place when the block ends without an error.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with replacing(f"{folder}/new/a.txt") as partial:
        ...         _ = partial.write_text("whole")
        ...     [file.name for file in Path(folder, "new").iterdir()]
        ['a.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def require_writable(path: str | Path, folder: bool = False) -> None:
    """Refuse, before any work, a file or folder that could not be written at the end; nothing is left on the disk.

    Args:
        path: of the file, which need not exist, nor its folders.
        folder: ``path`` is that of a folder.

    Raises:
        OSError: in one line, with what is in the way.

    Example:
        >>> require_writable("/dev/null/report.html")
        Traceback (most recent call last):
        OSError: /dev/null/report.html: cannot be written: /dev/null is not a folder
    """
    path = Path(path)
    if path.is_dir() and not folder:
        raise OSError(f"{path}: cannot be written: is a folder; give the name of a file")
    above = next(place for place in (path, *path.absolute().parents) if place.exists() and (folder or place != path))
    if not above.is_dir():
        raise OSError(f"{path}: cannot be written: {above} is not a folder")
    try:
        tempfile.TemporaryFile(dir=above).close()
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {above}: {error.strerror}") from None


def write_json(value: Any, path: str | Path) -> None:
    """Write JSON, whole or not at all, making its folder."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(value, indent=1) + "\n")


def write_tensors(tensors: Mapping[str, Tensor], header: Mapping[str, str], path: str | Path) -> None:
    """Write safetensors, whole or not at all, making their folder; equal content makes equal files."""
    from safetensors.torch import save

    content = save({name: tensor.contiguous() for name, tensor in tensors.items()}, dict(header))
    end = 8 + int.from_bytes(content[:8], "little")  # the library writes the header in an order that changes
    ordered = json.dumps(json.loads(content[8:end]), sort_keys=True).encode()
    ordered += b" " * (-len(ordered) % 8)
    with replacing(path) as partial:
        partial.write_bytes(len(ordered).to_bytes(8, "little") + ordered + content[end:])


def read_tensors(path: str | Path, advice: str) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Header and tensors of a safetensors file, on the CPU.

    Raises:
        ValueError: if it cannot be read, ending in ``advice``.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a readable safetensors file ({error}); {advice}") from error


def read_header(path: str | Path) -> dict[str, str]:
    """The header of a rawaug file, without its tensors.

    Raises:
        ValueError: if it is not a safetensors file written by rawaug.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            header = dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a readable safetensors file ({error}); fit or train it again") from error
    if header.get("format") != "rawaug":
        raise ValueError(f"{path}: not a rawaug file; give one written by rawaug fit or rawaug run")
    return header


def find_weights(name: str | Path, *more: Path) -> Path:
    """The file of weights ``name``: a path, or the name of an ISP that is shipped with the package.

    Args:
        more: further folders of shipped weights, such as :data:`denoisers.pretrained.FOLDER`.

    Raises:
        FileNotFoundError: naming the shipped ones.
    """
    folders = (WEIGHTS, *more)
    paths = [Path(name)] if Path(name).suffix else [folder / f"{name}.safetensors" for folder in folders]
    for path in paths:
        if path.is_file():
            return path
    shipped = ", ".join(sorted(p.stem for folder in folders for p in folder.glob("*.safetensors")))
    raise FileNotFoundError(f"{name}: not found; give a .safetensors file or a shipped name ({shipped})")


def digest(*parts: bytes) -> str:
    """SHA-256 of the parts, one after the other, in hexadecimal."""
    result = hashlib.sha256()
    for part in parts:
        result.update(part)
    return result.hexdigest()


def sha256(path: str | Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return digest(Path(path).read_bytes())


def fingerprint(*settings: Any) -> str:
    """A short hash of settings, equal if and only if they are.

    Example:
        >>> fingerprint("isp", {"seed": 0}) == fingerprint("isp", {"seed": 1})
        False
    """
    return digest(json.dumps(settings, sort_keys=True, default=str).encode())[:16]
