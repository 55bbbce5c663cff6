"""``rawaug denoise``: RAW files to denoised DNGs, pictures to pictures; in Python :func:`rawaug.denoise`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from denoisers.files import JOINT
from rawaug.commands import YAML
from rawaug.denoising.corrections import Correction, Corrections
from rawaug.denoising.denoiser import RawDenoiser, require_classical
from rawaug.denoising.files import DenoisedFolder, denoise_file, denoise_folder
from rawaug.denoising.frames import FrameDenoiser
from rawaug.denoising.pictures import PICTURES, PictureDenoiser
from rawaug.denoising.sources import PictureFiles, RawFiles
from rawaug.errors import escape
from rawaug.files import files_below, require_writable, write_json
from rawaug.io.content import ALL_PICTURE_EXTENSIONS, RAW_EXTENSIONS, content_of
from rawaug.registry import Spec


def run(
    source: str,
    out: str,
    /,
    *,
    denoiser: str | None = None,
    classical: Annotated[Spec | None, YAML] = None,
    noise: Annotated[tuple[float, float] | str, YAML] = "auto",
    strength: float = 1.0,
    linear: bool = False,
    self_ensemble: bool = False,
    greens: Correction = "auto",
    device: str = "auto",
    preview: str | None = None,
    json: str | None = None,
    overwrite: bool = False,
) -> None:
    """Denoise a RAW file to DNG, a JPEG, PNG or TIFF to another, or a folder of either.

    Args:
        source: a RAW file, a developed picture, or a folder of either.
        out: output DNG or picture, or output folder.
        denoiser: .safetensors file written by rawaug run, .onnx file written by rawaug export (faster on a CPU), or
            the name of a shipped denoiser; by default rawaug-small, rawaug-xtrans for X-Trans and Quad-Bayer, and
            rawaug-srgb for pictures.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, WNNM, KSVD, GLIDE,
            or {name, settings}.
        noise: auto (the NoiseProfile tag where the frame bears it out, else an estimate, else the camera's published
            law, else the levels of the folder's files of the same camera and ISO), profile, estimate, camera (the law
            that the denoiser was trained for), an ISP file (uses its stored noise law), the name of a camera, or
            [shot_var, read_var].
        strength: 1 removes the noise, 0.7 leaves 30% of it in the result, 0 changes nothing; of pictures, a factor on
            the estimated level of the noise: 2 removes more, 0.5 less.
        linear: demosaic too, to a linear DNG of full colour; by default with rawaug-joint.
        self_ensemble: average eight views of a network, at eight times the cost (rawaug-srgb averages two as it is).
        greens: auto makes the two greens of a Bayer sensor agree where they clearly differ, since demosaicing makes a
            maze of the difference; keep leaves them.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        preview: also write the result, developed by LibRaw, as this .jpg or .png; of a folder, a JPEG of each result
            to this folder.
        json: write to this file what was done to each RAW file: noise levels, corrections, seconds.
        overwrite: replace existing results.
    """
    kind: Any
    if is_picture(source):
        options = {"classical": classical, "linear": linear, "preview": preview, "json": json}
        options |= {"greens": greens != "auto", "noise": noise != "auto"}
        _require_none(source, options)
        views = 8 if self_ensemble else None
        kind = PictureFiles(
            PictureDenoiser.of(PICTURES if denoiser is None else denoiser, device, strength, views, "auto")
        )
    else:
        if json:
            require_writable(Path(json))
        raw_denoiser = choose_denoiser(denoiser, classical, self_ensemble, device, linear, strength)
        kind = RawFiles(_by_pattern(raw_denoiser, noise, Corrections(greens), self_ensemble, device, strength))

    if Path(source).is_dir():
        if Path(out).suffix.lower() in kind.formats and not Path(out).is_dir():
            extension = Path(out).suffix
            raise ValueError(f"{out}: {source} is a folder, and so is its output; give a name without {extension}")
        result = denoise_folder(source, out, kind, previews=preview, overwrite=overwrite)
    else:
        result = DenoisedFolder([denoise_file(source, out, kind, preview=preview, overwrite=overwrite)])

    if json:
        write_json({"files": [asdict(done) for done in result.files], "broken": result.broken}, json)
    print_denoised(result)
    if result.broken:
        raise ValueError(f"{source}: {len(result.broken)} of its files could not be denoised; they are listed above")


def is_picture(source: str) -> bool:
    """Whether a path is a developed picture by its content, or a folder with pictures and no RAW file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a file of neither kind.
    """
    path = Path(source)
    if path.is_dir():
        extensions = {file.suffix.lower() for file in files_below(path)}
        return extensions.isdisjoint(RAW_EXTENSIONS) and not extensions.isdisjoint(ALL_PICTURE_EXTENSIONS)

    content = content_of(path)
    if content.kind == "other":
        raise ValueError(f"{path}: is neither camera RAW nor a picture of a known format; check that it is complete")
    return content.kind == "picture"


def _require_none(source: str, options: dict[str, Any]) -> None:
    """Raise ValueError if options for RAW are given for a picture."""
    names = [f"--{name.replace('_', '-')}" for name, value in options.items() if value]
    if names:
        raise ValueError(f"{source}: is a developed picture; {', '.join(names)} is for RAW")


def choose_denoiser(
    denoiser: str | None,
    classical: Spec | None,
    self_ensemble: bool,
    device: str,
    linear: bool = False,
    strength: float = 1.0,
) -> RawDenoiser | None:
    """The denoiser that these options name; None where they name none, and the frame's pattern decides.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if there is no such denoiser, or the options contradict one another.
    """
    if classical is not None and (denoiser is not None or self_ensemble or linear):
        raise ValueError("classical: a filter takes no --denoiser, --self-ensemble or --linear; give one or the other")
    if classical is not None:
        require_classical([classical])

    spec = classical if classical is not None else denoiser
    if spec is None and linear:
        spec = JOINT
    if spec is None:
        return None

    views = 8 if self_ensemble else 1
    chosen = RawDenoiser.of(spec, device, "auto", views=views, strength=strength)
    if chosen.demosaics and not linear:
        raise ValueError(f"--denoiser {denoiser}: demosaics too, to a linear DNG; add --linear")
    if linear and not chosen.demosaics:
        raise ValueError(f"--linear: {denoiser} denoises the mosaic and does not demosaic; use {JOINT}")
    return chosen


def _by_pattern(
    denoiser: RawDenoiser | None,
    noise: Any,
    corrections: Corrections,
    self_ensemble: bool,
    device: str,
    strength: float,
) -> FrameDenoiser:
    if denoiser is not None:
        return FrameDenoiser(denoiser, noise, corrections)
    views = 8 if self_ensemble else 1
    return FrameDenoiser(None, noise, corrections, device, views=views, strength=strength)


def print_denoised(result: DenoisedFolder[Any]) -> None:
    """Print what was done, and what was not."""
    for done in result.files:
        print(done)
    if result.existing or result.broken:
        print(f"Denoised {len(result.files)} files; {result.existing} already existed, {len(result.broken)} failed.")
    for line in (*result.broken.values(), *result.left_out):
        print(escape(line))
