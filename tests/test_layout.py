"""The layout: arrows between rooms point one way, there are no circles, and importing one part loads no other."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(file.relative_to(ROOT) for part in ("rawaug", "denoisers") for file in (ROOT / part).rglob("*.py"))
BASE = {"bayer", "errors", "files", "metrics", "progress", "registry", "seeding", "version"}
CAMERA = BASE | {"camera", "isp", "noise", "kernels", "denoisers"}
PRODUCT = CAMERA | {"plugin", "data", "io", "synthesis", "denoising", "evaluation", "training"}
MAY_IMPORT: dict[str, set[str]] = {
    "bayer": {"seeding"},
    "errors": set(),
    "files": set(),
    "metrics": set(),
    "progress": set(),
    "registry": set(),
    "seeding": set(),
    "version": set(),
    "denoisers": {"bayer", "errors", "files", "registry"},
    "kernels": {"bayer", "registry"},
    "camera": BASE,
    "noise": BASE | {"camera", "io", "kernels"},
    "isp": BASE | {"camera", "kernels"},
    "io": BASE,
    "data": BASE | {"io"},
    "plugin": CAMERA | {"data", "io"},
    "synthesis": CAMERA | {"plugin", "data", "io"},
    "denoising": CAMERA | {"io"},
    "evaluation": CAMERA | {"plugin", "data", "io", "denoising"},
    "training": CAMERA | {"plugin", "data", "io", "denoising", "evaluation"},
    "explore": CAMERA | {"plugin", "data", "io", "denoising", "evaluation"},
    "commands": PRODUCT | {"explore", "experiment"},
    "experiment": PRODUCT,
    "paper": PRODUCT | {"experiment"},
    "cli": BASE | {"commands", "experiment", "paper"},
    "__main__": {"cli"},
}


def module_of(file: Path) -> str:
    parts = file.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(file): file for file in FILES}


def room_of(module: str) -> str:
    first, *rest = module.split(".")
    return rest[0] if first == "rawaug" and rest else first


def imported(file: Path) -> Iterator[str]:
    """The modules of the project that a file imports, in functions and for type checkers too."""
    for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{file}: relative imports are not used"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            assert all(alias.name != "*" for alias in node.names), f"{file}: star imports are not used"
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "import_module":
            names = [str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)]
        else:
            continue
        for name in names:
            if name in MODULES:
                yield name
            elif name.rpartition(".")[0] in MODULES:
                yield name.rpartition(".")[0]


LAZY = {"rawaug", "denoisers"}
"""Their names load on first use."""


@cache
def imports() -> dict[str, set[str]]:
    """By module, the others that it imports."""
    return {module: set(imported(MODULES[module])) - {module} for module in MODULES}


def test_few_modules_lie_loose() -> None:
    loose = {file.stem for file in FILES if len(file.parts) == 2 and file.parts[0] == "rawaug"}
    assert len(loose - {"__init__", "__main__"}) <= 8


def test_arrows_point_one_way() -> None:
    wrong = [
        f"{module} may not import {other}"
        for module in sorted(MODULES.keys() - LAZY)
        for other in sorted(imports()[module] - {"rawaug"})
        if room_of(other) not in MAY_IMPORT[room_of(module)] | {room_of(module)}
    ]
    assert not wrong


def test_no_circles() -> None:
    graph = {module: others - LAZY for module, others in imports().items() if module not in LAZY}
    list(TopologicalSorter(graph).static_order())  # CycleError names the circle
    rooms: dict[str, set[str]] = {}
    for module, others in graph.items():
        rooms.setdefault(room_of(module), set()).update(room_of(other) for other in others)
    list(TopologicalSorter({room: others - {room} for room, others in rooms.items()}).static_order())


FROM_FILE = "from rawaug import DictionaryISP; DictionaryISP.from_pretrained('universal')"
LOADED: dict[str, set[str]] = {
    "import rawaug": set(),
    "import rawaug.registry": {"registry"},
    "import denoisers": {"bayer", "errors", "files", "registry"},
    "import rawaug.noise": {"bayer", "seeding", "camera", "kernels", "noise", "errors", "files", "registry"},
    "from rawaug import DictionaryISP": {
        "bayer",
        "camera",
        "errors",
        "files",
        "isp",
        "kernels",
        "registry",
        "seeding",
    },
}
"""The rooms that code may load, besides the version, which every one of them loads."""

LOADER = """
import json, os, sys, traceback
import torch
before = set(sys.modules)
for code in sys.argv[1:]:
    if os.fork() == 0:
        try:
            exec(code)
            print(json.dumps([code, sorted(set(sys.modules) - before)]), flush=True)
        except BaseException:
            traceback.print_exc()
        os._exit(0)
    os.wait()
"""


@pytest.fixture(scope="module")
def loaded() -> dict[str, list[str]]:
    """The modules that code loads besides PyTorch's; each in a fork of one process."""
    command = [sys.executable, "-c", LOADER, *LOADED, FROM_FILE]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert not done.stderr
    return dict(json.loads(line) for line in done.stdout.splitlines())


@pytest.mark.parametrize("code", LOADED)
def test_importing_one_part_loads_no_other(code: str, loaded: dict[str, list[str]]) -> None:
    ours = {module for module in loaded[code] if module.split(".")[0] in ("rawaug", "denoisers")}
    assert ours and {room_of(module) for module in ours} - LAZY - {"version"} <= LOADED[code]


def test_loading_an_isp_does_not_import_the_compiler(loaded: dict[str, list[str]]) -> None:
    assert "rawaug.isp.model" in loaded[FROM_FILE]
    assert not [name for name in loaded[FROM_FILE] if name.startswith(("torch._dynamo", "torch._decomp"))]


@pytest.mark.parametrize("package", sorted(LAZY))
def test_every_public_name_can_be_had(package: str) -> None:
    module = __import__(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        module.no_such_name  # noqa: B018
