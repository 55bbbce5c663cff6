"""``rawaug info``: a readable description of a weights file, and a list of the cameras that are known by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from json import dumps
from pathlib import Path
from typing import Any

import torch

import denoisers
from denoisers.files import FOLDER
from rawaug.camera.matrices import load_cameras
from rawaug.camera.names import camera_key, similar_cameras
from rawaug.camera.own import Camera, is_camera_file
from rawaug.denoising.convolutions import (
    SIZE_OF_NETWORKS,
    USUAL,
    convolution_speeds,
    expect_seconds,
    has_fast_bfloat16,
    processor_name,
)
from rawaug.errors import count_of
from rawaug.files import find_weights, read_header, sha256
from rawaug.isp.description import describe_isp, tone_table
from rawaug.isp.model import DictionaryISP
from rawaug.noise.names import measured_ranges
from rawaug.noise.profiles import SPREAD, load_profiles, profile_ends
from rawaug.version import __version__

_WITH_LEVELS = 3
"""Largest number of cameras that are listed with the levels of their noise."""


def run(weights: str, /, *part: str, json: bool = False) -> None:
    """Describe a weights file, list the known cameras (rawaug info cameras [PART]), or time this machine.

    Args:
        weights: a .safetensors file, the name of a shipped ISP or denoiser, or the YAML file of a camera of your own;
            or the word cameras, or the word machine: how fast its convolutions are in float32 and bfloat16, which of
            them the networks use, and how long each takes for 12 megapixels.
        part: of the names of the cameras to list, such as A7 III.
        json: print one JSON object, for programs; an ISP's has its tone curve at 256 codes, and cameras' have their
            matrices.
    """
    if weights == "cameras":
        rows = cameras(" ".join(part))
        text = dumps({"cameras": rows}) if json else _table(rows)
    elif weights == "machine" and not part:
        text = dumps(machine_as_json()) if json else describe_machine()
    elif part:
        raise ValueError(f"{' '.join(part)}: too many arguments; use rawaug info cameras to look for a camera")
    else:
        text = dumps(read_facts(weights)) if json else describe_file(weights)
    print(text)


def machine_as_json() -> dict[str, Any]:
    """Collect the speed of this processor's convolutions, and what follows from it for the shipped networks."""
    return {
        "processor": processor_name(),
        "threads": torch.get_num_threads(),
        "gmac_per_second": convolution_speeds(),
        "precision": "bfloat16" if has_fast_bfloat16(torch.device("cpu")) else "float32",
        "seconds_of_12_megapixels": {name: round(expect_seconds(name, USUAL), 1) for name in SIZE_OF_NETWORKS},
    }


def describe_machine() -> str:
    """Write :func:`machine_as_json` as lines."""
    machine = machine_as_json()
    speeds = ", ".join(f"{speed:g} in {precision}" for precision, speed in machine["gmac_per_second"].items())
    lines = [
        f"{machine['processor']}, {count_of(machine['threads'], 'thread')}",
        f"convolutions, GMAC a second: {speeds}; networks compute in {machine['precision']}",
    ]
    for name, seconds in machine["seconds_of_12_megapixels"].items():
        lines.append(f"{name}: about {seconds:g} s for {USUAL:.0f} megapixels, without start, reading and writing")
    return "\n".join(lines)


def cameras(part: str = "") -> list[dict[str, Any]]:
    """List the cameras that have ``part`` in their names, in alphabetical order.

    Returns:
        For each camera ``name``, ``xyz_to_camera`` (3 x 3, or None) and ``iso``, the range of its measured noise (or
        None). If a part is given, cameras with a noise profile have ``noise``: by ISO the limits of likely levels.

    Raises:
        ValueError: if there is none.
    """
    published, profiles = load_cameras(), load_profiles()
    by_key: dict[str, dict[str, Any]] = {}
    for name, matrix in zip(published.names, published.xyz_to_camera.tolist(), strict=True):
        by_key.setdefault(camera_key(name), {"name": name, "xyz_to_camera": matrix, "iso": None})

    ranges = dict(zip(profiles.names, profiles.limits().exp().round().tolist(), strict=True))
    for name, iso in {**ranges, **measured_ranges()}.items():
        camera = by_key.setdefault(camera_key(name), {"name": name, "xyz_to_camera": None, "iso": None})
        camera["iso"] = iso

    by_name = {camera["name"]: camera for camera in by_key.values()}
    names = sorted(similar_cameras(part, by_name), key=str.casefold)
    if not names:
        raise ValueError(f"no camera has {part!r} in its name; rawaug info cameras lists all")

    rows = []
    for name in names:
        if part and name in ranges:
            by_name[name]["noise"] = profile_ends(name)
        rows.append(by_name[name])
    return rows


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write the cameras as a table, a few of them with the levels of their noise."""
    width = max(len(camera["name"]) for camera in rows)
    shot_spread, read_spread = "{:.2f} to {:.2f}".format(*SPREAD[0]), "{:.2f} to {:.2f}".format(*SPREAD[1])
    uncertainty = f"a profile's shot_var within {shot_spread}, read_var {read_spread}"

    lines = [f"{'camera':<{width}}  matrix  noise measured at ISO ({uncertainty})"]
    for camera in rows:
        matrix = "-" if camera["xyz_to_camera"] is None else "yes"
        iso = "-" if camera["iso"] is None else "{:g} to {:g}".format(*camera["iso"])
        lines.append(f"{camera['name']:<{width}}  {matrix:<6}  {iso}")
        if len(rows) <= _WITH_LEVELS:
            for level, shot_var, read_var in camera.get("noise", ()):
                shot_range = "{:.2e} to {:.2e}".format(*shot_var)
                read_range = "{:.2e} to {:.2e}".format(*read_var)
                lines.append(f"  ISO {level:<7g} shot_var {shot_range}   read_var {read_range}")
    return "\n".join(lines)


def read_facts(weights: str | Path) -> dict[str, Any]:
    """Collect what ``rawaug info --json`` prints.

    The keys of an ISP are those of :meth:`rawaug.isp.model.DictionaryISP.description`.
    """
    if is_camera_file(weights):
        return camera_as_json(Camera.load(weights)) | {"file": str(weights), "version": __version__}

    path = find_weights(weights, FOLDER)
    content: dict[str, Any] = {"file": str(path), "sha256": sha256(path), "version": __version__}
    if read_header(path)["kind"] == "isp":
        return content | describe_isp(DictionaryISP.from_pretrained(path))

    model, info = denoisers.load(path)
    return content | {
        "kind": "denoiser",
        "name": type(model).__name__,
        "parameters": sum(p.numel() for p in model.parameters()),
        "config": model.config,
        "info": info,
    }


def describe_file(weights: str | Path) -> str:
    """Describe a file in lines: kind, size, settings and atoms of weights, or the figures of a camera's YAML file."""
    if is_camera_file(weights):
        return describe_camera(Camera.load(weights))
    path = find_weights(weights, FOLDER)
    if read_header(path)["kind"] == "isp":
        return _describe_isp(path)

    content = read_facts(path)
    lines = [f"{path}: denoiser {content['name']}, {content['parameters'] / 1e6:.3f} M parameters"]
    for key, value in {**content["config"], **content["info"]}.items():
        lines.append(f"  {key}: {dumps(value)}")
    return "\n".join(lines)


def _describe_isp(path: Path) -> str:
    isp = DictionaryISP.from_pretrained(path)
    config = isp.config
    parameters = sum(p.numel() for p in isp.parameters())

    lines = [f"{path}: dictionary ISP, {parameters / 1e6:.3f} M parameters, {isp.cfa} output"]
    lines.append(f"  stages: {' '.join(config.stages)} mosaic; encoders {'on' if config.encoders else 'off'}")

    weights = isp.reverse_encoders.gain.prior.softmax(0)
    lines.append("  gain atoms (digital, red, blue; constant weight):")
    for atom, weight in zip(isp.gain.atoms().tolist(), weights.tolist(), strict=True):
        digital, red, blue = atom
        lines.append(f"    {digital:6.3f}  {red:6.3f}  {blue:6.3f}   {weight:.3f}")

    rows = "l1 norm 1"
    if config.cameras:
        rows = "sum 1"
    lines.append(f"  colour atoms (sRGB to camera, rows of {rows}):")
    for matrix in isp.colour.atoms().tolist():
        lines.append("    " + " | ".join("{:6.3f} {:6.3f} {:6.3f}".format(*row) for row in matrix))

    curve = tone_table(isp).mean(dim=1)
    points = []
    for code in (16, 32, 64, 128, 192, 255):
        points.append(f"{code} {curve[code].item():.4f}")
    lines.append(f"  tone and gamma, grey code to linear: {', '.join(points)}")
    for stage in isp.stages.ordered:
        if stage.extra_repr():
            lines.append(f"  {stage.name}: {stage.extra_repr()}")
    for key, value in isp.info.items():
        lines.append(f"  {key}: {dumps(value)}")
    return "\n".join(lines)


def describe_camera(camera: Camera) -> str:
    """Describe your own camera by the figures that the package uses: a line for each light and each ISO."""
    lines = [f"{camera.name}: camera, {camera.cfa}"]
    grid = f"black {camera.black_level:g}, white {camera.white:g} DN"
    if camera.bits is not None:
        grid += f", rounded to {count_of(camera.bits, 'bit')}"
    if camera.white == 1.0:
        grid = "no digital numbers"
    lines.append(f"  {grid}")

    lines.append("  matrix from linear sRGB to white-balanced camera RGB, and gains, by light:")
    for anchor in camera.anchors():
        rows = ["{:7.4f} {:7.4f} {:7.4f}".format(*row) for row in anchor.matrix.tolist()]
        gains = "{:.4f} {:.4f} {:.4f}".format(*anchor.gains.tolist())
        lines.append(f"    {anchor.light:<5} ({1e6 / anchor.mired:.0f} K)  {' | '.join(rows)}   gains {gains}")

    if camera.levels:
        lines.append("  noise, variances with white = 1:")
    else:
        lines.append("  noise: not stated")
    for level in camera.levels:
        at = "any ISO" if level.iso is None else f"ISO {level.iso:g}"
        values = []
        for name, value in level._asdict().items():
            if name != "iso" and value is not None:
                values.append(f"{name} {value:.4g}")
        lines.append(f"    {at:<10}  {'   '.join(values)}")

    for light, shares in camera.shading_by_light().items():
        height, width = shares.shape[1:]
        corners = shares[1, :: height - 1, :: width - 1].mean()
        lines.append(
            f"  lens shading in {light}: {height} x {width} cells, {float(corners):.2f} of green in the corners"
        )

    tone = "any of the ISP's"
    if camera.tone is not None:
        tone = dumps(camera.tone)
    lines.append(f"  tone: {tone}")
    return "\n".join(lines)


def camera_as_json(camera: Camera) -> dict[str, Any]:
    """Collect the figures of your own camera: as its file has them, by light, and by ISO as variances."""
    lights = {}
    for anchor in camera.anchors():
        lights[anchor.light] = {
            "kelvin": 1e6 / anchor.mired,
            "srgb_to_camera": anchor.matrix.tolist(),
            "gains": anchor.gains.tolist(),
        }
    levels = [level._asdict() for level in camera.levels]
    return {"kind": "camera", "figures": camera.to_json(), "lights": lights, "noise": levels}
