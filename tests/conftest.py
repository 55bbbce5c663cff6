"""The way to real camera files, where there are any."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def camera_files() -> Path:
    """The folder of real camera files, beside the repository or where RAWAUG_SHARED says."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("RAWAUG_SHARED", beside))
    if not (folder / "raw").is_dir():
        pytest.skip(f"no real camera files in {folder}; RAWAUG_SHARED names their folder")
    return folder
