"""File systems of a few kilobytes, for faults that need a full one; root or a mount namespace on Linux makes them."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path


class Skipped(Exception):
    """The fault cannot be made here, or does not concern the command; the text says which."""


@contextlib.contextmanager
def small_file_system(place: Path, kilobytes: int) -> Iterator[None]:
    """Mount a tmpfs of this size over a folder.

    Raises:
        Skipped: where that is not allowed.
    """
    place.mkdir(exist_ok=True)
    mount(place, kilobytes)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def mount(place: Path, kilobytes: int) -> None:
    """Likewise, for as long as nobody unmounts it."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        raise Skipped("needs the right to mount file systems")


def small_shared_memory(kilobytes: int) -> None:
    """A /dev/shm of this size for this process alone and those that come from it.

    Raises:
        Skipped: where that is not allowed.
    """
    new_mount_namespace = 0x00020000
    if ctypes.CDLL(None, use_errno=True).unshare(new_mount_namespace):
        raise Skipped(f"needs a mount namespace ({os.strerror(ctypes.get_errno())})")
    subprocess.run(["mount", "--make-rprivate", "/"], check=True, capture_output=True)
    mount(Path("/dev/shm"), kilobytes)
