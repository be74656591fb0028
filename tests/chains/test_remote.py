"""Files at a URL: what comes when, what is asked anew, and what stays in the cache."""

import itertools
import os
import pickle
import sys
from pathlib import Path

import pytest

from chains import remote
from chains.errors import InputError

fsspec = pytest.importorskip("fsspec", reason="the extra 'remote' is not installed")
COUNT = itertools.count()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of this test alone, as if the process had just begun."""
    monkeypatch.setenv("RIGCAL_CACHE", str(tmp_path / "cache"))
    begin(monkeypatch)
    return tmp_path / "cache"


def begin(monkeypatch):
    """As another process begins: it knows nothing."""
    for name, empty in (("_known", {}), ("_listed", set()), ("_held", [-1.0])):
        monkeypatch.setattr(remote, name, empty)


@pytest.fixture
def there():
    """A folder in memory: its URL, and how to write a file into it."""
    url, files = f"memory://rec{next(COUNT)}", fsspec.filesystem("memory")

    def write(name, data):
        files.pipe(f"{url}/{name}", data)

    for name in ("rig.yaml", "reference/mesh.ply", "scans/a.parquet", "scans/b.parquet"):
        write(name, name.encode())
    return url, write


@pytest.mark.parametrize(
    "url", ["s3://bucket/a/rec", "https://host:80/rec", "memory://rec", "file:///data/rec"]
)
def test_a_url_and_the_folder_that_stands_for_it_tell_each_other(url, cache):
    here = remote.place(url)
    assert here.is_relative_to(cache) and remote.url_of(here) == url
    assert remote.url_of(here / "scans/a.parquet") == f"{url}/scans/a.parquet"
    assert remote.place(Path(url)) == remote.place(f"{url}/") == here  # a Path drops slashes
    assert remote.place(here) == here


@pytest.mark.parametrize("path", ["rec", "/data/rec", "s3", "C:/rec", "zip://rec", "a/s3://rec"])
def test_any_other_path_is_itself(path):
    assert remote.place(path) == remote.here(path) == remote.fetched(Path(path)) == Path(path)
    assert remote.url_of(Path(path)) is None


@pytest.mark.parametrize("url", ["s3://a/../b", "file:///../etc", "s3://a//b", "s3://a::zip://b"])
def test_a_url_that_leads_elsewhere_is_refused(url):
    with pytest.raises(InputError, match="no URL of a folder"):
        remote.place(url)


def test_what_is_small_comes_at_once_and_a_scan_when_it_is_read(there, cache):
    url, _ = there
    folder = remote.here(url)
    come = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert come == {"rig.yaml", "reference/mesh.ply"}
    scans = remote.files(folder, "scans/*.parquet")
    assert scans == remote.files(folder / "scans", "*.parquet")
    assert [path.name for path in scans] == ["a.parquet", "b.parquet"]
    assert remote.files(folder, "*.parquet") == [] and not scans[0].exists()
    assert remote.fetched(scans[0]).read_text() == "scans/a.parquet"
    assert scans[0].exists() and not scans[1].exists()


def test_a_file_comes_again_only_where_it_has_changed(there, monkeypatch):
    url, write = there
    scan = remote.fetched(remote.here(url) / "scans/a.parquet")
    number = scan.stat().st_ino
    begin(monkeypatch)
    assert remote.fetched(scan).stat().st_ino == number
    write("scans/a.parquet", b"SCANS/A.PARQUET")  # of the same size
    assert remote.fetched(scan).read_text() == "scans/a.parquet"  # as this process found it
    remote.here(url, anew=True)
    assert remote.fetched(scan).read_text() == "SCANS/A.PARQUET"


def test_what_is_gone_there_is_gone_here(there):
    url, _ = there
    folder = remote.here(url)
    fsspec.filesystem("memory").rm(f"{url}/reference/mesh.ply")
    remote.here(url, anew=True)
    assert not (folder / "reference/mesh.ply").exists() and (folder / "rig.yaml").exists()


def test_the_cache_keeps_the_scans_that_were_read_last(there, cache, monkeypatch):
    url, write = there
    for k in range(10):
        write(f"scans/{k}.parquet", bytes(1000))
    monkeypatch.setattr(remote, "CACHE_BYTES", 4000)
    folder = remote.here(url)
    for at_s, k in enumerate((0, 1, 2, 3, 0, 4, 5)):
        scan = remote.fetched(folder / f"scans/{k}.parquet")
        os.utime(scan, (at_s, scan.stat().st_mtime))
    left = {path.stem for path in (folder / "scans").iterdir()}
    assert {"0", "4", "5"} <= left and not {"1", "2"} & left
    assert sum(path.stat().st_size for path in (folder / "scans").iterdir()) <= 4000
    assert (folder / "rig.yaml").exists()


def test_a_file_that_does_not_come_whole_is_not_kept(there, monkeypatch):
    url, _ = there
    scan = remote.here(url) / "scans/a.parquet"

    def cut(self, name, target, **options):
        Path(target).write_bytes(b"sc")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "get_file", cut)
    with pytest.raises(InputError, match=f"{url}/scans/a.parquet: 2 of its 15 bytes came"):
        remote.fetched(scan)
    assert list(scan.parent.iterdir()) == []


def test_another_machine_has_its_own_cache(there, tmp_path, monkeypatch):
    """What goes to a worker is the URL, and it asks for itself."""
    from calib.linear.parallel.parcels import Parcels

    url, _ = there
    scan = remote.here(url) / "scans/a.parquet"
    here, other = Parcels(), Parcels()
    parcel = here.packed({"path": scan}, None)
    assert str(tmp_path).encode() not in pickle.dumps(tuple(parcel))
    monkeypatch.setenv("RIGCAL_CACHE", str(tmp_path / "other"))
    begin(monkeypatch)
    path = other.opened(parcel, here.name)["path"]
    assert path.is_relative_to(tmp_path / "other")
    assert remote.fetched(path).read_text() == "scans/a.parquet"


def test_what_cannot_be_reached_is_one_sentence(monkeypatch):
    with pytest.raises(InputError, match=r"memory://nowhere: nothing is there; give the URL of a"):
        remote.here("memory://nowhere")
    with pytest.raises(InputError, match="nothing is there"):
        remote.fetched(remote.place("memory://nowhere/scans/a.parquet"))

    def fails(self, *names, **options):
        raise ConnectionError("no route to host\nand more")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "find", fails)
    with pytest.raises(InputError, match=r"^memory://away cannot be reached: no route to host$"):
        remote.here("memory://away")


@pytest.mark.parametrize(("module", "url"), [("fsspec", "memory://a"), ("gcsfs", "gs://a/b")])
def test_without_the_library_it_is_said_what_to_install(module, url, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'rigcal\[remote\]'$"):
        remote.here(url)
