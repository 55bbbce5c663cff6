"""Files, written completely or not at all; locks of folders and hashes; safetensors and JSON, checked on reading.

Weights, parameters and states are safetensors (https://huggingface.co/docs/safetensors) with text in their header:
``format`` is ``rawaug``, and ``kind`` says what the file holds. Numbers in files must be finite.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from safetensors import SafetensorError, safe_open
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

OF_NO_DATASET = (".DS_Store", "Thumbs.db")
"""Files that macOS and Windows leave in folders."""

LOCK = "rawaug.lock"
"""Name of the lock file in an output folder."""

MOST_BYTES = 2**32
"""Largest size of an input file; larger ones are refused before they are read."""

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped ISPs."""


def _plain_loader() -> Any:
    """PyYAML's loader of plain values: libyaml's, which is five times as fast, or Python's if it was built without."""
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def yaml_value(text: str) -> Any:
    """Parse plain values of YAML 1.2, in which ``1e-4`` is a number, and ``on``, ``off``, ``yes`` and ``no`` are words.

    Raises:
        ValueError: if the text is not YAML.
    """
    import yaml

    class Loader(_plain_loader()):  # type: ignore[misc]
        pass

    Loader.yaml_implicit_resolvers = {}
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items():
        if first not in "tTfF":
            resolvers = [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":bool")]
        Loader.yaml_implicit_resolvers[first] = resolvers

    number = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+0123456789"))
    try:
        return yaml.load(text, Loader)  # only safe values
    except (yaml.YAMLError, LookupError, AttributeError, TypeError, OverflowError) as error:  # of a tag without a value
        raise ValueError(f"not YAML: {' '.join(str(error).split())}") from None


MOST_YAML_BYTES, MOST_YAML_LEVELS = 2**16, 50
"""Limits of a YAML file of settings."""


def read_yaml(file: str | Path, what: str) -> Any:
    """Read plain values from a YAML file of settings.

    Args:
        file: its path.
        what: what the file should be, for messages, such as ``"camera"``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not YAML, too long or too deep, or uses aliases.
    """
    import yaml

    require_file(file, what)
    size = Path(file).stat().st_size
    if size > MOST_YAML_BYTES:
        raise ValueError(f"{file}: has {size} bytes, a {what} has at most {MOST_YAML_BYTES}")
    try:
        text = Path(file).read_text(encoding="utf-8")
        depth = 0
        for event in yaml.parse(text, Loader=_plain_loader()):
            if isinstance(event, yaml.AliasEvent):  # a few lines of aliases can be billions of values
                raise ValueError("uses aliases (*name); write the values out")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_YAML_LEVELS:
                raise ValueError(f"is nested more than {MOST_YAML_LEVELS} levels deep")
        return yaml_value(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not a {what} ({' '.join(str(error).split())})") from None


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a path next to ``path``, which it replaces if the block ends without an error; writers take turns."""
    from filelock import FileLock

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)

    key = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]  # the name itself may already be of maximal length
    partial = path.with_name(f".{key}.partial")
    lock = path.with_name(f".{key}.lock")
    try:
        with FileLock(lock):
            try:
                partial.unlink(missing_ok=True)
                yield partial
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
                lock.unlink(missing_ok=True)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial), partial, str(lock)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold the lock ``file`` in this block.

    Its folder is created if necessary, and then removed again if it stays empty.

    Raises:
        ValueError: if another run holds the lock.
        OSError: if the folder is removed in the meantime.
    """
    from filelock import FileLock, Timeout

    folder = file.absolute().parent
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"{folder}: in use by another run ({file.name}); wait for it, or choose another") from None

    try:
        yield
        if not file.exists():
            raise OSError(f"{folder}: was removed or replaced during this run; run the same command again")
    finally:
        file.unlink(missing_ok=True)  # while it is locked, so whoever waits for this file tries again
        lock.release()
        if is_new and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def one_at_a_time(folder: Callable[..., Path | None]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function to hold the lock of the folder that ``folder(*arguments)`` names; None needs no lock."""

    def decorator(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            place = folder(*args, **kwargs)
            with nullcontext() if place is None else locked(place / LOCK):
                return function(*args, **kwargs)

        return call

    return decorator


def to_json(value: Any, indent: int | None = None) -> str:
    """Write JSON: paths become text, tensors become lists, and infinity and NaN, which JSON lacks, become null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Tensor):
        return _finite(value.tolist())
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return value


def parse_object(text: str) -> dict[str, Any]:
    """Parse a JSON object from an untrusted file.

    Raises:
        ValueError: if the text is anything else, or a number in it is not finite.
    """

    def finite(number: str) -> float:
        if not math.isfinite(float(number)):
            raise ValueError(f"{number} is not a finite number")
        return float(number)

    try:
        value = json.loads(text, parse_constant=finite, parse_float=finite)
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error}") from None
    except RecursionError:
        raise ValueError("not JSON that can be read: too deeply nested") from None
    if not isinstance(value, dict):
        raise ValueError(f"must be a JSON object, got {type(value).__name__}")
    return value


def require_output(
    path: str | Path,
    overwrite: bool = False,
    extensions: Sequence[str] = (),
    inputs: Iterable[str | Path] = (),
    advice: str = "",
) -> Path:
    """Refuse, before any work, an output file that would replace something or could not be written.

    Args:
        path: the file.
        overwrite: whether an existing file may be replaced.
        extensions: the endings that the file may have, in lower case; any, if there are none.
        inputs: the files that are read, which are never replaced.
        advice: the end of the message about another ending.

    Returns:
        The path.

    Raises:
        ValueError: if it has no name or another ending, is an input, or exists and may not be replaced.
        OSError: if it cannot be written.
    """
    if not str(path):
        raise ValueError("the name of an output file is empty; give one")

    path = Path(path)
    if path.is_dir():
        raise OSError(f"{path}: cannot be written: is a folder; give the name of a file")
    if extensions and path.suffix.lower() not in extensions:
        advice = advice or f"give a name that ends in {' or '.join(extensions)}"
        raise ValueError(f"{path}: {advice}")
    for file in inputs:
        if path.resolve() == Path(file).resolve() or (path.exists() and Path(file).exists() and path.samefile(file)):
            raise ValueError(f"{path}: is the input file; give another name")
    if path.exists() and not overwrite:
        raise ValueError(f"{path}: exists; give another name, or overwrite=True to replace it")

    require_folder(path.absolute().parent, path)
    return path


def require_folder(folder: str | Path, output: str | Path | None = None) -> None:
    """Refuse, before any work, a folder that could not be made or written to, for the sake of ``output`` in it."""
    path = Path(output or folder)
    above = Path(folder)
    while not above.exists():
        above = above.absolute().parent
    if not above.is_dir():
        raise OSError(f"{path}: cannot be written: {above} is not a folder")

    try:
        tempfile.TemporaryFile(dir=above).close()
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {above}: {error.strerror}") from None


def write_bytes(content: bytes | memoryview, path: str | Path) -> None:
    """Write a file, completely or not at all.

    Encoders of pictures, figures and archives write to memory first: some of them do not report a full disk, and one
    ends the process.
    """
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_text(text: str, path: str | Path) -> None:
    """Write a text file in UTF-8, completely or not at all; what UTF-8 cannot hold is escaped."""
    write_bytes(text.encode("utf-8", errors="backslashreplace"), path)


def write_json(value: Any, path: str | Path) -> None:
    """Write a JSON file, completely or not at all."""
    write_text(f"{to_json(value, indent=1)}\n", path)


def write_tensors(tensors: Mapping[str, Tensor], header: Mapping[str, str], path: str | Path) -> None:
    """Write safetensors, completely or not at all; equal content makes equal files."""
    from safetensors.torch import save

    content = save({name: tensor.contiguous() for name, tensor in tensors.items()}, dict(header))

    # The library writes the header in an order that changes from run to run.
    end = 8 + int.from_bytes(content[:8], "little")
    sorted_header = json.dumps(json.loads(content[8:end]), sort_keys=True).encode()
    sorted_header += b" " * (-len(sorted_header) % 8)
    write_bytes(len(sorted_header).to_bytes(8, "little") + sorted_header + content[end:], path)


def read_tensors(
    path: str | Path, advice: str, infinite: Collection[str] = ()
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read the header and the tensors of a safetensors file, on the CPU.

    Args:
        path: the file.
        advice: the end of messages, which says what to do.
        infinite: names of tensors that may hold infinity.

    Raises:
        ValueError: if the file cannot be read, or a value is not finite.
    """
    header, tensors = _read_safetensors(path, advice, with_tensors=True)
    for name, tensor in tensors.items():
        values = tensor.float() if tensor.is_floating_point() else tensor  # 8 bits have no test of their own
        if not (values.isfinite().all() or (name in infinite and not values.isnan().any())):
            raise ValueError(f"{path}: tensor {name} has values that are not finite; {advice}")
    return header, tensors


def read_metadata(path: str | Path) -> dict[str, str]:
    """Read the metadata of any safetensors file, without its tensors; raise ValueError if it is damaged."""
    header, _ = _read_safetensors(path, "copy or download it again", with_tensors=False)
    return header


def read_header(path: str | Path) -> dict[str, str]:
    """Read the header of a rawaug file, without its tensors; raise ValueError if it is not one."""
    advice = "give one written by rawaug fit, rawaug run or denoisers.save, or copy it again"
    header, _ = _read_safetensors(path, advice, with_tensors=False)
    if header.get("format") != "rawaug" or "kind" not in header:
        raise ValueError(f"{path}: not a rawaug file; give one written by rawaug fit or rawaug run")
    return header


def _read_safetensors(path: str | Path, advice: str, with_tensors: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors.torch import load

    tensors = {}
    try:
        with safe_open(str(path), framework="pt") as file:
            header = dict(file.metadata() or {})
        if with_tensors:
            tensors = load(Path(path).read_bytes())  # get_tensor turns Ctrl-C into an error of the file
        return header, tensors
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not a readable safetensors file ({reason}); {advice}") from error


def find_weights(name: str | Path, *more: Path) -> Path:
    """Find the file of weights ``name``: a path, or the name of an ISP that is shipped with the package.

    Args:
        name: the path or the name.
        more: further folders to look in.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    folders = (WEIGHTS, *more)
    if Path(name).suffix:
        candidates = [Path(name)]
    else:
        candidates = [folder / f"{name}.safetensors" for folder in folders]
    for candidate in candidates:
        if candidate.is_file():
            return candidate

    denoiser = Path(__file__).parents[1] / "denoisers" / "weights" / f"{name}.safetensors"
    if denoiser.is_file():
        raise ValueError(f"{name}: is a denoiser, not an ISP; load it by denoisers.from_pretrained")
    names: list[str] = []
    for folder in folders:
        names += [file.stem for file in folder.glob("*.safetensors")]
    shipped = ", ".join(sorted(names))
    raise FileNotFoundError(f"{name}: not found; give a .safetensors file or a shipped name ({shipped})")


def digest(*parts: bytes) -> str:
    """Compute the SHA-256 of the parts, one after the other, in hexadecimal."""
    return hashlib.sha256(b"".join(parts)).hexdigest()


def sha256(path: str | Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal, while it is read."""
    require_file(path)
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def require_file(path: str | Path, what: str = "file") -> None:
    """Refuse anything but a regular file (a pipe or a device may never end), and more than :data:`MOST_BYTES`."""
    try:
        status = Path(path).stat()
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such {what}") from None
    except OSError as error:  # e.g. a link to itself, or a folder that may not be entered
        raise OSError(f"{path}: cannot be opened ({error.strerror})") from None
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{path}: is a pipe, a device or a folder, and must be a regular file")
    if status.st_size > MOST_BYTES:
        raise OSError(f"{path}: has {status.st_size} bytes, above the limit of {MOST_BYTES}")


def fingerprint(*settings: Any) -> str:
    """Hash settings to 16 hexadecimal digits, which are equal if the settings are."""
    return digest(json.dumps(settings, sort_keys=True, default=str).encode())[:16]


def read_keyed_json(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a JSON object, and apart from it the key that :func:`cached` has written; other text counts as empty."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return content, {"key": content.pop("key", None)}
    except (ValueError, AttributeError, TypeError):
        return {}, {}


def write_keyed_json(value: Mapping[str, Any], path: Path, key: str) -> None:
    """Write a JSON object and its key."""
    write_json({"key": key, **value}, path)


def cached(
    path: Path,
    inputs: Any,
    make: Callable[[], T],
    read: Callable[[Path], tuple[Any, Mapping[str, Any]]] = read_keyed_json,
    write: Callable[[Any, Path, str], None] = write_keyed_json,
    done: str = "",
) -> T:
    """Read what was made of the same inputs before, or else make and write it.

    Args:
        path: file of the result.
        inputs: everything that the result depends on, as JSON: settings, seeds, stamps of frames.
        make: makes the result.
        read: ``read(path)`` gives a result and what its file says of it, in which ``key`` is the hash of the inputs; a
            JSON object by default.
        write: ``write(result, path, key)``.
        done: what is printed before the path if there is nothing to make, such as ``"already trained"``.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     for seed in (0, 0, 1):
        ...         cached(Path(folder) / "sum.json", ["sum", seed], lambda: print("adds") or {"sum": seed + 1})["sum"]
        adds
        1
        1
        adds
        2
    """
    key = fingerprint(inputs)
    if path.is_file():
        result, info = read(path)
        if info.get("key") == key:
            if done:
                print(f"{done}: {path}")
            return result

    result = make()
    write(result, path, key)
    return result


def require_same_settings(
    path: Path, settings: Mapping[str, object], overwrite: bool = False, advice: str = "choose another folder"
) -> None:
    """Write the settings of a folder's files to ``path``, or require that they equal those stored there.

    Raises:
        ValueError: if they differ, with ``advice``.
    """
    if overwrite or not path.is_file():
        write_json(dict(settings), path)
        return

    try:
        stored = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: not valid JSON ({error.msg}); choose another folder") from None
    for key in stored | dict(settings):
        before, now = stored.get(key), settings.get(key)
        if before != now:
            raise ValueError(f"{path}: made with {key} {before}, not {now}; {advice}")


def files_below(folder: str | Path, extensions: tuple[str, ...] = ("",)) -> Iterator[Path]:
    """Yield the files of a folder and its subfolders in no particular order; links to folders are not followed.

    Files that macOS and Windows leave there are left out. If there is no such folder, there are no files.

    Args:
        folder: the folder.
        extensions: the endings that count, in lower case.
    """

    def refuse(error: OSError) -> None:
        if not isinstance(error, (FileNotFoundError, NotADirectoryError)):
            raise error

    for parent, folders, files in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if name != "__MACOSX"]
        for file in files:
            if file.startswith("._") or file in OF_NO_DATASET:
                continue
            if file.lower().endswith(extensions):
                yield Path(parent, file)


def files_in(path: str | Path, what: str, extensions: tuple[str, ...] = ("",)) -> list[Path]:
    """List the files of a folder as :func:`files_below` does, sorted, or the file ``path`` itself.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if the folder has no such file.
    """
    path = Path(path)
    if not path.is_dir():
        require_file(path, f"{what} file or folder")
        return [path]
    files = sorted(files_below(path, extensions))
    if not files:
        raise ValueError(f"{path}: contains no {what} file; supported extensions are {', '.join(extensions)}")
    return files
