"""``rawaug denoise``: RAW files to denoised DNGs, pictures to pictures; in Python :func:`rawaug.denoise`."""

from __future__ import annotations

from dataclasses import asdict
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

from rawaug.commands import YAML, as_options, network_or_filter, require_results
from rawaug.denoising.convolutions import USUAL, expect_seconds
from rawaug.denoising.denoise import files_for, is_mixed
from rawaug.denoising.folder import DenoisedFolder, denoise_file, denoise_folder
from rawaug.denoising.pictures import PictureFiles
from rawaug.denoising.raw import Denoised, Greens, RawFiles, Strength
from rawaug.errors import count_of, escape
from rawaug.files import write_json
from rawaug.io.content import PICTURE_KINDS
from rawaug.registry import Spec


def run(
    source: str,
    out: str,
    /,
    *,
    denoiser: str | None = None,
    classical: Annotated[Spec | None, YAML] = None,
    noise: Annotated[tuple[float, float] | str | dict[str, Any], YAML] = "auto",
    strength: Strength = 1.0,
    linear: bool = False,
    self_ensemble: bool = False,
    greens: Greens = "auto",
    defects: str = "mend",
    guard: Literal["auto", "on", "off"] = "auto",
    device: str = "auto",
    preview: str | None = None,
    json: str | None = None,
    verbose: bool = False,
    overwrite: bool = False,
) -> None:
    """Denoise a RAW file to DNG, a JPEG, PNG or TIFF to another, or a folder of them.

    Args:
        source: a RAW file, a developed picture, or a folder of them; of RAW files and pictures with the same stem, the
            RAW files are denoised.
        out: output DNG or picture, or output folder.
        denoiser: .safetensors file written by rawaug run, .onnx file written by rawaug export (faster on a CPU), or
            the name of a shipped denoiser; by default rawaug-base, rawaug-small on a processor where base would take
            more than a minute for 12 megapixels, rawaug-xtrans for X-Trans and Quad-Bayer, and
            rawaug-srgb for pictures.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, WNNM, KSVD, GLIDE,
            or {name, settings}.
        noise: auto (the NoiseProfile tag where the frame bears it out, else an estimate, else the camera's published
            law, else the levels of the folder's files of the same camera and ISO), profile, estimate, camera (the law
            that the denoiser was trained for), an ISP file (uses its stored noise law), a camera's .yaml sheet, the
            name of a camera, [shot_var, read_var], or a law as {name: MeasuredNoise, levels: ...}.
        strength: 1 removes the noise, 0.7 leaves 30% of it in the result, 0 changes nothing; auto leaves grain of 1% of
            mid grey, so that fine texture looks natural at low ISO; for pictures, a factor on the estimated level of
            the noise: 2 removes more, 0.5 less.
        linear: also demosaic, to a linear DNG of full colour; by default with rawaug-joint.
        self_ensemble: average eight views of a network, at eight times the cost.
        greens: auto makes the two greens of a Bayer sensor agree if they clearly differ, since demosaicing turns the
            difference into a maze; keep leaves them as they are.
        defects: mend replaces single hot and dead pixels, as every shipped network does; keep leaves such sites as they
            are, for small stars; or a map of the sensor's defects, of rawaug defects or dcraw's .badpixels, whose sites
            are replaced while all others are kept.
        guard: on blends the result of a Bayer mosaic with its input, and with NonLocalMeans, where it is estimated to
            be worse, as at a camera's base ISO or at a small light; it takes two more passes over a sample of the
            frame; auto does so for networks, off for none.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        preview: also write the result, developed by LibRaw, as this .jpg or .png; for a folder, write a JPEG of each
            result to this folder.
        json: write what was done to each file to this file: noise levels and corrections of RAW, and seconds.
        verbose: print noise levels, how they were found, and corrections of RAW files in numbers.
        overwrite: replace existing results.
    """
    spec = network_or_filter(denoiser, classical, self_ensemble, linear)
    require_results(json, None, overwrite, [source])
    guarded = None if guard == "auto" else guard == "on"
    for_raw = {"linear": linear, "noise": noise, "greens": greens, "defects": defects, "guard": guarded}
    kind = files_for(source, spec, strength, self_ensemble, device, **for_raw)
    if spec is None and isinstance(kind, RawFiles) and kind.denoiser.name == "rawaug-small":
        seconds = expect_seconds("rawaug-base", USUAL)
        print(
            f"rawaug-small denoises, as rawaug-base would take about {seconds:.0f} s for {USUAL:.0f} megapixels here; "
            "--denoiser rawaug-base uses it all the same"
        )

    if Path(source).is_dir():
        if Path(out).suffix.lower() in kind.formats and not Path(out).is_dir():
            extension = Path(out).suffix
            raise ValueError(f"{out}: {source} is a folder, and so is its output; give a name without {extension}")
        if spec is None and is_mixed(Path(source)):
            factor = 1.0 if isinstance(strength, str) else strength
            pictures = PictureFiles(None, factor, self_ensemble, device)
            result = denoise_folder(
                source, out, kind, previews=preview, overwrite=overwrite, elsewhere=("rendering", *PICTURE_KINDS)
            )
            not_pictures = ("RAW file", "other file")
            result += denoise_folder(source, out, pictures, overwrite=overwrite, elsewhere=not_pictures)
        else:
            result = denoise_folder(source, out, kind, previews=preview, overwrite=overwrite)
    else:
        _, done = denoise_file(source, out, kind, preview=preview, overwrite=overwrite)
        result = DenoisedFolder([done])

    if json is not None:
        write_json({"files": [asdict(done) for done in result.files], "broken": result.broken}, json)
    print_denoised(result, verbose)
    if result.broken:
        raise ValueError(f"{source}: {len(result.broken)} of its files could not be denoised; they are listed above")


def print_denoised(result: DenoisedFolder[Any], verbose: bool = False) -> None:
    """Print what was done, and what was not."""
    for done in result.files:
        line = done.details if verbose and isinstance(done, Denoised) else str(done)
        print(as_options(line, signature(run).parameters))
    if result.existing or result.broken:
        files = count_of(len(result.files), "file")
        print(f"Denoised {files}; {result.existing} already existed, {len(result.broken)} failed.")
    for line in (*result.broken.values(), *result.left_out, *result.remarks):
        print(as_options(escape(line), signature(run).parameters))
