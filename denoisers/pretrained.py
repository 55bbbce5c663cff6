"""Denoisers that ship with the package, by name; each has a model card beside its weights.

``rawaug-small`` is for CPUs: PMRID's network at its published width, trained by ``recipes/pretrain.yaml`` on sRGB
photographs alone.
"""

from __future__ import annotations

from pathlib import Path

from denoisers.network import Denoiser
from denoisers.weight_files import load

FOLDER = Path(__file__).parent / "weights"
"""Of the shipped weights and their cards."""

DEFAULT = "rawaug-small"
"""What denoises where no denoiser is named."""


def shipped() -> list[str]:
    """The names that :func:`from_pretrained` knows."""
    return sorted(file.stem for file in FOLDER.glob("*.safetensors"))


def find(name: str | Path) -> Path:
    """The file of a denoiser: a path to a ``.safetensors`` file, or the name of a shipped one.

    Raises:
        FileNotFoundError: if it is neither, naming the shipped ones.
    """
    path = Path(name) if Path(name).suffix else FOLDER / f"{name}.safetensors"
    if not path.is_file():
        known = ", ".join(shipped()) or "none in this installation"
        raise FileNotFoundError(f"{name}: no such denoiser; give a .safetensors file or a shipped one ({known})")
    return path


def from_pretrained(name: str | Path = DEFAULT) -> Denoiser:
    """A trained denoiser, on the CPU in eval mode.

    Args:
        name: of a shipped one, or a path to a file that ``rawaug run`` or :func:`denoisers.save` wrote.

    Raises:
        FileNotFoundError: if there is no such denoiser.
        ValueError: if the file is not a denoiser's.

    Example:
        >>> denoiser = from_pretrained("rawaug-small")  # doctest: +SKIP
        >>> clean = denoiser(noisy, variance)  # both (B, 4, h, w) packed RAW; variance of each value  # doctest: +SKIP
    """
    return load(find(name))[0]
