"""Known advisories of the pinned dependencies, asked of OSV (https://osv.dev) in one request.

    python .ci/advisories.py [--must] [constraints.txt]

Exit status 1 if a pinned version has one. Where the database cannot be reached, one line says so, with status 0; with
``--must``, as in the job of a release, with status 1.
"""

from __future__ import annotations

import json
import re
import sys
import urllib.request
from pathlib import Path
from typing import Any

URL = "https://api.osv.dev/v1/querybatch"
SECONDS = 10.0


def pinned(text: str) -> list[tuple[str, str]]:
    """Name and version of each line ``name==version``."""
    return re.findall(r"^([A-Za-z0-9._-]+)==([^\s;]+)", text, flags=re.MULTILINE)


def advisories(packages: list[tuple[str, str]], url: str = URL) -> dict[str, list[str]]:
    """By package, the identifiers of its advisories; OSError if the database cannot be reached."""
    queries = [{"package": {"name": name, "ecosystem": "PyPI"}, "version": version} for name, version in packages]
    body = json.dumps({"queries": queries}).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=SECONDS) as answer:
        results: list[dict[str, Any]] = json.load(answer)["results"]
    found = ([entry["id"] for entry in result.get("vulns", [])] for result in results)
    return {f"{name} {version}": ids for (name, version), ids in zip(packages, found, strict=True) if ids}


def main(arguments: list[str], url: str = URL) -> int:
    must, files = "--must" in arguments, [word for word in arguments if word != "--must"]
    packages = pinned(Path(files[0] if files else "constraints.txt").read_text(encoding="utf-8"))
    try:
        found = advisories(packages, url)
    except (OSError, ValueError, KeyError) as error:
        print(f"advisories: not checked, {url} cannot be reached ({type(error).__name__})")
        return int(must)
    for package, ids in found.items():
        print(f"{package}: {', '.join(ids)}")
    print(f"advisories: {len(packages)} pinned packages, {len(found)} with a known advisory")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
