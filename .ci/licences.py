"""Lists the licences of what rigcal is installed with, from what each package says of itself.

python .ci/licences.py requirements.lock docs/licences.md
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

LONGEST = (
    60  # of a licence's name; packages that put its whole text there are taken by the first line
)
HEAD = """# Licences of what rigcal uses

Made by `make licences` from what each installed package says of itself; the versions are those of
`requirements.lock`. rigcal itself is under the BSD-3-Clause licence. None of these packages is
part of rigcal's wheel or sdist: pip fetches them.

| package | version | licence |
|---|---|---|
"""


def locked(path: Path) -> Iterator[tuple[str, str]]:
    """Names and versions in a lock file, those for other systems or Pythons included."""
    for found in re.finditer(r"^([A-Za-z0-9._-]+)==([^\s;]+)", path.read_text(), re.M):
        yield found[1], found[2]


def licence(package: str) -> str:
    """What a package says its licence is; nothing where it is not installed here."""
    try:
        said = metadata(package)
    except PackageNotFoundError:
        return ""
    classified = [
        line.rpartition(" :: ")[2]
        for line in said.get_all("Classifier", [])
        if line.startswith("License :: ") and line != "License :: OSI Approved"
    ]
    free = (said.get("License") or "").strip().splitlines() or [""]
    return (
        said.get("License-Expression")
        or ", ".join(classified)
        or free[0].strip()[:LONGEST]
        or "not said in its metadata"
    )


def main() -> None:
    """Write the page."""
    lock, page = map(Path, sys.argv[1:])
    packages: dict[str, list[str]] = {}
    for name, version in locked(lock):
        packages.setdefault(name, []).append(version)
    rows = []
    for name, versions in sorted(packages.items()):
        said = licence(name) or "not installed on the machine that made this page"
        rows.append(f"| {name} | {', '.join(versions)} | {said.replace('|', '/')} |")
    page.write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
