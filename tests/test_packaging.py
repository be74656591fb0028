"""What is installed, what it is installed with, and what is said of both."""

import importlib.metadata
import re
import tomllib

import pytest

from .programs import RIGCAL, ROOT, execute

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")
LOCKED = dict(re.findall(r"^([a-z0-9-]+)==([^\s;]+)[^\n]*(?=\\\n    --hash=sha256:)", LOCK, re.M))


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_rigcal_tells_the_one_version_there_is():
    done = execute([*RIGCAL, "--version"])
    assert (done.returncode, done.stdout) == (0, f"rigcal {PROJECT['version']}\n")
    assert importlib.metadata.version("rigcal") == PROJECT["version"]


def test_the_lock_has_every_dependency_and_a_hash_for_each():
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    names = {canonical(re.match(r"[\w.-]+", d)[0]) for group in groups for d in group} - {"rigcal"}
    assert names <= set(LOCKED), sorted(names - set(LOCKED))
    pinned = re.findall(r"^[a-z0-9-]+==", LOCK, re.M)
    assert len(pinned) > 100 and len(re.findall(r"^\S+==[^\n]*\\\n    --hash", LOCK, re.M)) == len(
        pinned
    )
    assert not re.search(r"^(?!#|[a-z0-9-]+==|    (--hash=sha256:[0-9a-f]{64}|#))", LOCK[:-1], re.M)


@pytest.mark.parametrize("page", ["docs/licences.md"])
def test_the_page_of_licences_has_all_that_is_locked(page):
    rows = re.findall(r"^\| (\S+) \| ([^|]+) \| ([^|]+) \|$", (ROOT / page).read_text(), re.M)
    listed = {name: versions.split(", ") for name, versions, _ in rows[1:]}
    assert set(listed) == set(LOCKED)
    assert all(LOCKED[name] in versions for name, versions in listed.items())
    assert all(licence.strip() for *_, licence in rows)
