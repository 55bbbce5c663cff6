"""What a package index shows, for the repository that a release is built from; the checkout is changed.

    python .ci/release.py https://host/owner/name

A package index has no files beside the README: its links and pictures are made absolute. setup.cfg gets the URLs.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

RAW = {".png", ".jpg", ".svg"}


def absolute(readme: str, repository: str) -> str:
    """The README with every relative link made absolute; pictures are taken as files, not as pages about them."""

    def link(found: re.Match[str]) -> str:
        page = "raw" if Path(found[1]).suffix in RAW else "blob"
        return f"]({repository}/{page}/main/{found[1]})"

    return re.sub(r"\]\((?!https?://|#)([^)\s]+)\)", link, readme)


def with_urls(setup: str, repository: str) -> str:
    """setup.cfg with the project's URLs."""
    urls = {"Homepage": "", "Documentation": "/blob/main/docs/index.md", "Changelog": "/blob/main/CHANGELOG.md"}
    urls["Issues"] = "/issues"
    lines = "".join(f"    {name} = {repository}{path}\n" for name, path in urls.items())
    return setup.replace("[metadata]\n", f"[metadata]\nproject_urls =\n{lines}", 1)


if __name__ == "__main__":
    for name, change in (("README.md", absolute), ("setup.cfg", with_urls)):
        file = Path(name)
        file.write_text(change(file.read_text(encoding="utf-8"), sys.argv[1].rstrip("/")), encoding="utf-8")
