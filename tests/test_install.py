"""constraints.txt is one lock for every Python version and platform: what is asked for has one pin, and it fits."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
PLATFORMS = {"linux": ("Linux", "x86_64"), "darwin": ("Darwin", "arm64"), "win32": ("Windows", "AMD64")}
LOCKED = ("raw", "train", "data", "test", "docs", "export", "explore")


def environment(python: str, platform: str) -> dict[str, str]:
    system, machine = PLATFORMS[platform]
    return {
        "python_version": python,
        "python_full_version": f"{python}.1",
        "sys_platform": platform,
        "platform_system": system,
        "platform_machine": machine,
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "os_name": "nt" if platform == "win32" else "posix",
        "extra": "",
    }


def applying(lines: list[str], where: dict[str, str]) -> list[Requirement]:
    found = [Requirement(line) for line in lines]
    return [one for one in found if one.marker is None or one.marker.evaluate(where)]


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("platform", PLATFORMS)
def test_every_requirement_has_one_pin_that_fits(python: str, platform: str) -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    asked = setup["options"]["install_requires"].split("\n")
    extras = {extra: setup.get("options.extras_require", extra, raw=True) for extra in LOCKED}
    asked += [line for lines in extras.values() for line in lines.split("\n")]
    asked = [line for line in asked if line and "%(" not in line]
    where = environment(python, platform)
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pins: dict[str, str] = {}
    for pin in applying(lines, where):
        name, (exact,) = canonicalize_name(pin.name), pin.specifier
        assert name not in pins, f"{name} is pinned twice"
        assert exact.operator == "=="
        pins[name] = exact.version
    for requirement in applying(asked, where):
        version = pins.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} has no pin: run make lock"
        assert version in requirement.specifier, f"{requirement.name} {version}: run make lock"


def test_cuda_packages_are_left_to_torch() -> None:
    """The CPU build must not be kept from installing, nor the CUDA build from its own exact pins."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert not [line for line in lines if line.startswith(("nvidia-", "cuda-"))]


def test_workflows_run_targets_of_the_makefile_on_the_locked_versions() -> None:
    makefile, workflow = (ROOT / "Makefile").read_text(), (ROOT / ".github/workflows/test.yml").read_text()
    assert re.search(r"^PYTHONS := (.*)$", makefile, re.MULTILINE)[1].split() == list(PYTHONS)  # type: ignore[index]
    assert re.findall(r'"(3\.\d+)"', workflow.partition("matrix:")[2].partition("steps:")[0]) == list(PYTHONS)
    for target in re.findall(r"run: make (\w+)", workflow + (ROOT / ".github/workflows/release.yml").read_text()):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"make {target} is no target"
