"""``rawaug denoise``: RAW files to denoised DNGs, pictures to pictures; in Python :func:`rawaug.denoise`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from denoisers.files import DEFAULT, JOINT
from rawaug.commands import YAML
from rawaug.denoising.corrections import Correction, Corrections
from rawaug.denoising.denoiser import RawDenoiser, require_classical
from rawaug.denoising.frames import DenoisedFolder, denoise_file, denoise_folder
from rawaug.denoising.pictures import PICTURES, PictureDenoiser, denoise_picture, denoise_pictures, list_denoised
from rawaug.errors import escape
from rawaug.files import files_below, require_writable, write_json
from rawaug.io.content import ALL_PICTURE_EXTENSIONS, content_of, list_files
from rawaug.io.raw import RAW_EXTENSIONS
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
            the name of a shipped denoiser; by default rawaug-small, and rawaug-srgb for pictures.
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
        preview: also write the result, developed by LibRaw, as this .jpg or .png.
        json: write to this file what was done to each RAW file: noise levels, corrections, seconds.
        overwrite: replace existing results.
    """
    if is_picture(source):
        given = {"classical": classical, "linear": linear, "preview": preview}
        given |= {"greens": greens != "auto", "json": json}
        if unfit := [name for name, value in given.items() if value] + ["noise"] * (noise != "auto"):
            options = ", ".join(f"--{name.replace('_', '-')}" for name in unfit)
            raise ValueError(f"{source}: is a developed picture; {options} is for RAW")
        spec = PICTURES if denoiser is None else denoiser
        of_pictures = PictureDenoiser.of(spec, device, strength, 8 if self_ensemble else None, "auto")
        denoise_all(source, out, of_pictures, overwrite)
        return
    if json:
        require_writable(Path(json))
    corrections = Corrections(greens)
    made = chosen(denoiser, classical, self_ensemble, device, linear, strength)
    if not Path(source).is_dir():
        done = denoise_file(source, out, made, noise, corrections=corrections, preview=preview, overwrite=overwrite)
        print_denoised(DenoisedFolder([done]), json)
        return
    if preview is not None:
        raise ValueError(f"--preview {preview}: is for one file, and {source} is a folder")
    if Path(out).suffix.lower() == ".dng" and not Path(out).is_dir():
        raise ValueError(f"{out}: {source} is a folder, and so is its output; give a name without .dng")
    result = denoise_folder(source, out, made, noise, corrections=corrections, overwrite=overwrite)
    print_denoised(result, json)
    print_left_out(Path(source))
    if result.broken:
        raise ValueError(f"{source}: {len(result.broken)} of its files could not be denoised, listed above")


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


def denoise_all(source: str, out: str, denoiser: PictureDenoiser, overwrite: bool) -> None:
    """Denoise a picture or a folder of them, and print what was done."""
    broken: dict[str, str] = {}
    left_out: list[str] = []
    if Path(source).is_dir():
        done, broken = denoise_pictures(source, out, denoiser, overwrite)
        left_out = list_denoised(Path(source)).lines()
    else:
        done = [denoise_picture(source, out, denoiser, overwrite)]
    for one in done:
        print(f"{escape(one.out)}: noise of {one.removed:.1f} in 255 removed, {one.seconds:.1f} s")
    for line in (*broken.values(), *left_out):
        print(escape(line))
    if broken:
        raise ValueError(f"{source}: {len(broken)} of its files could not be denoised, listed above")


def print_left_out(folder: Path) -> None:
    """Print a line for each kind of file in a folder of RAW that is not denoised with it."""
    listing = list_files(folder, RAW_EXTENSIONS, "neither RAW nor a picture that is known")
    for line in listing.lines():
        print(escape(line))


def chosen(
    denoiser: str | None,
    classical: Spec | None,
    self_ensemble: bool,
    device: str,
    linear: bool = False,
    strength: float = 1.0,
) -> RawDenoiser:
    """The denoiser that these options name, or the shipped one that is taken where they name none."""
    if classical is not None and (denoiser is not None or self_ensemble or linear):
        raise ValueError("classical: a filter takes no --denoiser, --self-ensemble or --linear; give one or the other")
    usual = (JOINT if linear else DEFAULT) if denoiser is None else denoiser
    if classical is not None:
        require_classical([classical])
    views = 8 if self_ensemble else 1
    made = RawDenoiser.of(usual if classical is None else classical, device, "auto", views=views, strength=strength)
    if made.upscale > 1 and not linear:
        raise ValueError(f"--denoiser {denoiser}: demosaics too, to a linear DNG; add --linear")
    if linear and made.upscale == 1:
        raise ValueError(f"--linear: {denoiser} denoises the mosaic and does not demosaic; use {JOINT}")
    return made


def print_denoised(result: DenoisedFolder, json: str | None = None) -> None:
    """Print what was done, and write it to ``json``."""
    if json:
        write_json({"files": [asdict(done) for done in result.files], "broken": result.broken}, json)
    for done in result.files:
        levels = f"shot_var {done.shot_var:.3g}, read_var {done.read_var:.3g} ({done.noise_source})"
        clipped = f"; {done.below_zero:.2%} below digital number 0, written as 0" if done.below_zero else ""
        print(f"{escape(done.out)}: {levels}{done.corrected}, {done.seconds:.1f} s{clipped}")
    if result.existing or result.broken:
        print(f"{len(result.files)} denoised, {result.existing} already existed, {len(result.broken)} failed")
    for reason in result.broken.values():
        print(escape(reason))
    if result.unread:
        print(escape(f"not read, no decoder for these kinds of RAW: {', '.join(result.unread)}"))
