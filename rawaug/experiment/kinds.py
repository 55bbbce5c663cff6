"""What the key ``experiment`` of a recipe names: denoisers to train where it is missing, or a comparison of methods."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any, get_type_hints

from rawaug.experiment.plan import planned
from rawaug.experiment.recipe import Recipe
from rawaug.experiment.run_folder import require_free
from rawaug.registry import EXPERIMENTS


def settings_of(kind: str) -> type[Any]:
    """The dataclass of the keys of a kind of experiment: the type of its function's first argument."""
    settings: type[Any] = next(iter(get_type_hints(EXPERIMENTS[kind]).values()))
    return settings


def dry_run(kind: str, settings: Any, overwrite: bool = False) -> None:
    """Print what data a training would use, and do the run in its shortest form in a temporary folder."""
    folder = require_free(settings, overwrite)
    if isinstance(settings, Recipe):
        print("\n".join(planned(settings, {}).lines(settings)))
    with TemporaryDirectory() as elsewhere, redirect_stdout(io.StringIO()):
        EXPERIMENTS[kind](replace(settings.shortest(), out=elsewhere))
    print(f"Dry run: no problems found, nothing written to {folder}")
