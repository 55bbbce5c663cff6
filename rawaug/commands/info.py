"""``rawaug info``: a readable description of a weights file, and the list of cameras that are known by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from json import dumps
from pathlib import Path
from typing import Any

import denoisers
from denoisers.files import FOLDER
from rawaug.files import find_weights, read_header, sha256
from rawaug.isp.camera_names import camera_key, similar_cameras
from rawaug.isp.cameras import load_cameras
from rawaug.isp.model import DictionaryISP
from rawaug.isp.own_cameras import Camera, is_camera_file
from rawaug.noise.cameras import SPREAD, load_profiles, measured_ranges, profile_ends
from rawaug.version import __version__

_WITH_LEVELS = 3
"""So few cameras are listed with their levels."""


def run(weights: str, /, *part: str, json: bool = False) -> None:
    """Describe a weights file, or list the known cameras: rawaug info cameras [PART].

    Args:
        weights: a .safetensors file, the name of a shipped ISP or denoiser, or the YAML file of a camera of your own;
            or the word cameras.
        part: of the names of the cameras to list, such as A7 III.
        json: print one JSON object, for programs; of an ISP with its tone curve at 256 codes, of cameras with their
            matrices.
    """
    if weights == "cameras":
        found = cameras(" ".join(part))
        print(dumps({"cameras": found}) if json else _listed(found))
        return
    if part:
        raise ValueError(f"{' '.join(part)}: too many arguments; a part of a name goes with the word cameras")
    print(dumps(as_json(weights)) if json else describe(weights))


def cameras(part: str = "") -> list[dict[str, Any]]:
    """The cameras with ``part`` in their names: ``name``, ``xyz_to_camera`` (3 x 3) and ``iso`` of the noise, or None.

    One with a noise profile has ``noise``, the least and the greatest levels that are likely by ISO.

    Raises:
        ValueError: if there is none.
    """
    listed, profiles = load_cameras(), load_profiles()
    found: dict[str, dict[str, Any]] = {}
    for name, matrix in zip(listed.names, listed.xyz_to_camera.tolist(), strict=True):
        found.setdefault(camera_key(name), {"name": name, "xyz_to_camera": matrix, "iso": None})
    limits = dict(zip(profiles.names, profiles.limits().exp().round().tolist(), strict=True))
    for name, iso in {**limits, **measured_ranges()}.items():
        found.setdefault(camera_key(name), {"name": name, "xyz_to_camera": None, "iso": None})["iso"] = iso
    named = {camera["name"]: camera for camera in found.values()}
    wanted = sorted(similar_cameras(part, named), key=str.casefold)
    if not wanted:
        raise ValueError(f"no camera has {part!r} in its name; rawaug info cameras lists all")
    few = {name for name in wanted if part and name in limits}
    return [named[name] | ({"noise": profile_ends(name)} if name in few else {}) for name in wanted]


def _listed(found: Sequence[Mapping[str, Any]]) -> str:
    width = max(len(camera["name"]) for camera in found)
    shot, read = ("{:.2f} to {:.2f}".format(*ends) for ends in SPREAD)
    known = f"a profile's shot_var within {shot}, read_var {read}"
    lines = [f"{'camera':<{width}}  matrix  noise measured at ISO ({known})"]
    for camera in found:
        iso = "-" if camera["iso"] is None else "{:g} to {:g}".format(*camera["iso"])
        lines.append(f"{camera['name']:<{width}}  {'-' if camera['xyz_to_camera'] is None else 'yes':<6}  {iso}")
        lines += [_level_row(*ends) for ends in camera.get("noise", ()) if len(found) <= _WITH_LEVELS]
    return "\n".join(lines)


def _level_row(iso: float, shot_var: tuple[float, float], read_var: tuple[float, float]) -> str:
    shot, read = ("{:.2e} to {:.2e}".format(*ends) for ends in (shot_var, read_var))
    return f"  ISO {iso:<7g} shot_var {shot}   read_var {read}"


def as_json(weights: str | Path) -> dict[str, Any]:
    """What ``rawaug info --json`` prints: of an ISP see :func:`rawaug.isp.model.DictionaryISP.description`."""
    if is_camera_file(weights):
        return camera_as_json(Camera.load(weights)) | {"file": str(weights), "version": __version__}
    path = find_weights(weights, FOLDER)
    content: dict[str, Any] = {"file": str(path), "sha256": sha256(path), "version": __version__}
    if read_header(path)["kind"] == "isp":
        return content | DictionaryISP.from_pretrained(path).description()
    model, info = denoisers.load(path)
    parameters = sum(p.numel() for p in model.parameters())
    name = {"kind": "denoiser", "name": type(model).__name__, "parameters": parameters}
    return content | name | {"config": model.config, "info": info}


def describe(weights: str | Path) -> str:
    """Kind, size, settings and, for an ISP, its atoms as numbers; the figures of a camera's YAML file."""
    if is_camera_file(weights):
        return describe_camera(Camera.load(weights))
    path = find_weights(weights, FOLDER)
    if read_header(path)["kind"] == "isp":
        return _describe_isp(path)
    content = as_json(path)
    lines = [f"{path}: denoiser {content['name']}, {content['parameters'] / 1e6:.3f} M parameters"]
    lines += [f"  {key}: {dumps(value)}" for key, value in {**content["config"], **content["info"]}.items()]
    return "\n".join(lines)


def _describe_isp(path: Path) -> str:
    isp = DictionaryISP.from_pretrained(path)
    config, parameters = isp.config, sum(p.numel() for p in isp.parameters())
    lines = [f"{path}: dictionary ISP, {parameters / 1e6:.3f} M parameters, {isp.cfa} output"]
    lines.append(f"  stages: {' '.join(config.stages)} mosaic; encoders {'on' if config.encoders else 'off'}")
    weights = isp.reverse_encoders.gain.prior.softmax(0)
    lines.append("  gain atoms (digital, red, blue; constant weight):")
    for atom, weight in zip(isp.gain.atoms().tolist(), weights.tolist(), strict=True):
        lines.append("    " + "  ".join(f"{value:6.3f}" for value in atom) + f"   {weight:.3f}")
    rows = "sum 1" if config.cameras else "l1 norm 1"
    lines.append(f"  colour atoms (sRGB to camera, rows of {rows}):")
    for matrix in isp.colour.atoms().tolist():
        lines.append("    " + " | ".join(" ".join(f"{value:6.3f}" for value in row) for row in matrix))
    curve = isp.tone_curve().mean(dim=1)
    codes = ", ".join(f"{code} {curve[code].item():.4f}" for code in (16, 32, 64, 128, 192, 255))
    lines.append(f"  tone and gamma, grey code to linear: {codes}")
    lines += [f"  {text}" for stage in isp.ordered_stages if (text := stage.describe())]
    lines += [f"  {key}: {dumps(value)}" for key, value in isp.info.items()]
    return "\n".join(lines)


def describe_camera(camera: Camera) -> str:
    """The figures of a camera of one's own, as the package uses them: a line for each light and each ISO."""
    lines = [f"{camera.name}: camera, {camera.cfa}"]
    grid = f"black {camera.black_level:g}, white {camera.white:g} DN"
    if camera.bits is not None:
        grid += f", rounded to {camera.bits} bits"
    lines.append(f"  {grid}" if camera.white != 1.0 else "  no digital numbers")

    lines.append("  matrix from linear sRGB to white-balanced camera RGB, and gains, by light:")
    for anchor in camera.anchors():
        rows = [" ".join(f"{value:7.4f}" for value in row) for row in anchor.matrix.tolist()]
        gains = " ".join(f"{value:.4f}" for value in anchor.gains.tolist())
        lines.append(f"    {anchor.light:<5} ({1e6 / anchor.mired:.0f} K)  {' | '.join(rows)}   gains {gains}")

    lines.append("  noise, variances with white = 1:" if camera.levels else "  noise: not stated")
    for level in camera.levels:
        at = "any ISO" if level.iso is None else f"ISO {level.iso:g}"
        lines.append(f"    {at:<10}  shot_var {level.shot_var:.4g}   read_var {level.read_var:.4g}")

    tone = "any of the ISP's" if camera.tone is None else dumps(camera.tone)
    lines.append(f"  tone: {tone}")
    return "\n".join(lines)


def camera_as_json(camera: Camera) -> dict[str, Any]:
    """The figures of a camera of one's own: as its file has them, by light, and by ISO as variances."""
    lights = {}
    for anchor in camera.anchors():
        lights[anchor.light] = {
            "kelvin": 1e6 / anchor.mired,
            "srgb_to_camera": anchor.matrix.tolist(),
            "gains": anchor.gains.tolist(),
        }
    levels = [level._asdict() for level in camera.levels]
    return {"kind": "camera", "figures": camera.to_json(), "lights": lights, "noise": levels}
