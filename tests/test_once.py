"""What is made once: by whom, for whom, and until when."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from . import once as module
from .once import Once


@pytest.fixture
def once(tmp_path):
    count = iter(range(99))

    def place(name):
        folder = tmp_path / f"{name}{next(count)}"
        folder.mkdir()
        return folder

    return Once(tmp_path / "store", place)


def make(folder, *what):
    with (folder.parent / "made").open("a") as file:
        file.write("x")
    document = {"recording": str(folder / "rec"), "what": what}
    (folder / "run.json").write_text(json.dumps(document))


def slowly(folder):
    time.sleep(0.2)
    make(folder)


def times(once):
    return len((once.store / "made").read_text())


def test_it_is_made_once_and_each_copy_is_ones_own(once):
    first = once(make, "tiny", 1)
    (first / "run.json").write_text("changed")
    second = once(make, "tiny", 1)
    read = json.loads((second / "run.json").read_text())
    assert read == {"recording": str(second / "rec"), "what": ["tiny", 1]}
    assert times(once) == 1


def test_what_differs_in_anything_is_made_anew(once, tmp_path, monkeypatch):
    for what in (("tiny", 1), ("tiny", 2), ("default", 1)):
        once(make, *what)
    assert times(once) == 3
    (tmp_path / "calib").mkdir()
    source = tmp_path / "calib" / "solve.py"
    source.write_text("tolerance = 1e-6\n")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    once(make, "tiny", 1)
    once(make, "tiny", 1)
    assert times(once) == 4
    source.write_text("tolerance = 1e-5\n")
    once(make, "tiny", 1)
    assert times(once) == 5


def test_who_asks_while_it_is_made_waits_for_it(once):
    with ThreadPoolExecutor(3) as pool:
        folders = list(pool.map(once, [slowly] * 3))
    assert all((folder / "run.json").is_file() for folder in folders)
    assert len(set(folders)) == 3 and times(once) == 1


def test_what_could_not_be_made_is_not_kept(once):
    def fail(folder):
        (folder / "half").touch()
        raise OSError("disk full")

    for _ in range(2):
        with pytest.raises(OSError, match="disk full"):
            once(fail)
