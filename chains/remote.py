"""Recordings at a URL: a folder here stands for each, and its files come when they are asked for.

``s3://bucket/rec`` stands at ``CACHE/s3/bucket/rec``, which follows from the names alone: all else
knows folders only. `here` lists what there is, and brings what is small; a scan comes when it is
read (`fetched`). The cache keeps the scans read last, `CACHE_BYTES` of them. A file that is here
already is asked after once by each process: where its size, or what its place tells of its version,
is another by then, it comes again.

This is fsspec's door.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from chains.errors import CutShortError, InputError

CACHE_BYTES = 20e9  # of scans: a choice; a disk has it, and it is 20,000 scans of 131,072 beams
ROOM = 0.9  # of it is what stays when it is full, so that not each scan has to look for room
KINDS = ("s3", "gs", "gcs", "az", "abfs", "http", "https", "file", "memory")
# A Path has one slash where a URL has two or three.
_URL = re.compile(rf"({'|'.join(KINDS)}):/+(.+)")
_SCANS = "scans"  # the folder whose files come one by one
# What places tell of a file's version, the first of which is taken: a listing may tell more.
_TELLING = ("ETag", "etag", "mtime", "LastModified", "last_modified", "Last-Modified", "created")

_known: dict[Path, tuple[int | None, int]] = {}  # files: their size, and a number of their version
_listed: set[Path] = set()  # folders of which `_known` has all files
_lock = Lock()
_held = [-1.0]  # bytes of scans in the cache; negative: not counted yet


def place(path: Path | str) -> Path:
    """The folder or file here that stands for a URL; of any other path, that itself.

    Raises:
        InputError: the URL has no proper path.
    """
    found = _URL.fullmatch(str(path))
    if found is None:
        return Path(path)
    kind, rest = found.groups()
    parts = rest.strip("/").split("/")
    if any(part in ("", ".", "..") for part in parts) or "::" in rest or "\0" in rest:
        raise InputError(
            f"{kind}://{rest}: this is no URL of a folder; give one such as s3://bucket/folder"
        )
    return _cache().joinpath(kind, *parts)


def url_of(path: Path) -> str | None:
    """The URL that a folder or file here stands for; None of any other."""
    if not path.is_relative_to(_cache()):
        return None
    kind, *parts = path.relative_to(_cache()).parts or ("",)
    return f"{kind}:{'///' if kind == 'file' else '//'}{'/'.join(parts)}" if parts else None


def here(path: Path | str, anew: bool = False) -> Path:
    """A folder with all that is at a URL but scans, which are listed; any other path as it is.

    Args:
        path: of a recording, or its URL; or of a file.
        anew: whether it is asked what there is though this process has done so before.

    Raises:
        InputError: it cannot be reached, or nothing is there.
    """
    folder = place(path)
    url = url_of(folder)
    if url is None or (folder in _listed and not anew):
        return folder
    with _reaching(url):
        files, root = _filesystem(url)
        files.invalidate_cache()
        found = files.find(root, detail=True)
        names = {name: files._strip_protocol(name)[len(root) :].strip("/") for name in found}
    if not found:
        raise InputError(f"{url}: nothing is there; give the URL of a recording's folder")
    for old in [each for each in _known if each.is_relative_to(folder)]:
        del _known[old]
    for name, inside in names.items():
        file = folder.joinpath(*inside.split("/")) if inside else folder
        if ".." not in file.parts and "\\" not in inside:
            _known[file] = _version(found[name])
    for old in folder.rglob("*") if folder.is_dir() else ():
        if old.is_file() and old not in _known:
            old.unlink(missing_ok=True)
    for file in list(_known):
        if file.is_relative_to(folder) and file.parent.name != _SCANS:
            fetched(file)
    _listed.add(folder)
    return folder


def files(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder whose way from there is of a pattern, whether they are here yet or not.

    Args:
        folder: any; one that stands for a URL, or is inside of one, was asked for with `here`.
        pattern: as of `Path.glob`, without ``**``.
    """
    if url_of(folder) is None:
        return [path for path in folder.glob(pattern) if path.is_file()]
    inside = [path.relative_to(folder) for path in _known if path.is_relative_to(folder)]
    depth = len(Path(pattern).parts)
    return [folder / way for way in inside if len(way.parts) == depth and way.match(pattern)]


class Digests(NamedTuple):
    """Of some files.

    Args:
        whole: SHA-256 (hex) of their names and contents.
        each: name -> SHA-256 (hex) of the contents of that one.
    """

    whole: str
    each: dict[str, str]


def digests(folder: Path, patterns: Sequence[str]) -> Digests:
    """Of the files of a folder that are of any pattern, as of `files`; each is read once."""
    sha, each = hashlib.sha256(), {}
    for path in map(fetched, sorted({path for some in patterns for path in files(folder, some)})):
        name, own = path.relative_to(folder).as_posix(), hashlib.sha256()
        sha.update(f"{name}\0{path.stat().st_size}\0".encode())
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                sha.update(block)
                own.update(block)
        each[name] = own.hexdigest()
    return Digests(sha.hexdigest(), each)


def fetched(path: Path) -> Path:
    """A file that is here now, if it stands for a URL; any other as it is.

    Raises:
        InputError: it cannot be reached.
        FileNotFoundError: nothing is there.
    """
    url = url_of(path)
    if url is None:
        return path
    size, version = _known.get(path, (None, 0))
    if size is None:
        with _reaching(url):
            files, name = _filesystem(url)
            size, version = _known[path] = _version(files.info(name))
    with suppress(FileNotFoundError):
        now = path.stat()
        if now.st_size == size and int(now.st_mtime) == version:
            os.utime(path, (time.time(), version))
            return path
    _fetch(url, path, size, version)
    return path


def _fetch(url: str, path: Path, size: int | None, version: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{uuid.uuid4().hex}")
    try:
        with _reaching(url):
            files, name = _filesystem(url)
            files.get_file(name, str(temporary))
        came = temporary.stat().st_size
        if size is not None and came != size:
            raise CutShortError(f"{url}: {came} of its {size} bytes came; try again")
        if path.parent.name == _SCANS:
            _make_room(temporary, came)
        os.utime(temporary, (time.time(), version))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _make_room(came: Path, size: int) -> None:
    """Count a scan that came, and remove those read longest ago where there are too many."""
    with _lock:
        if 0 <= _held[0] <= CACHE_BYTES - size:
            _held[0] += size
            return
        found = []
        for file in _cache().rglob(f"{_SCANS}/*"):
            with suppress(FileNotFoundError):
                if file != came:
                    found.append((file.stat().st_atime, file.stat().st_size, file))
        _held[0] = size + sum(each for _, each, _ in found)
        for _, each, file in sorted(found):
            if _held[0] <= ROOM * CACHE_BYTES:
                break
            file.unlink(missing_ok=True)
            _held[0] -= each


def _cache() -> Path:
    """Where files from elsewhere are kept; RIGCAL_CACHE says where else."""
    usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rigcal"
    return Path(os.environ.get("RIGCAL_CACHE") or usual).resolve()


def _filesystem(url: str) -> tuple[Any, str]:
    """fsspec's way to a URL, and the name that it has there."""
    try:
        import fsspec
    except ImportError:
        raise InputError(f"{url}: this needs fsspec: pip install 'rigcal[remote]'") from None
    return fsspec.core.url_to_fs(url)


@contextmanager
def _reaching(url: str) -> Iterator[None]:
    """What goes wrong on the way as one sentence: every kind of place has errors of its own."""
    try:
        yield
    except InputError:
        raise
    except ImportError as error:
        raise InputError(f"{url}: {error}: pip install 'rigcal[remote]'") from None
    except FileNotFoundError:
        raise InputError(f"{url}: nothing is there; give the URL of a recording's folder") from None
    except Exception as error:
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise CutShortError(f"{url} cannot be reached: {why}") from None


def _version(info: dict[str, Any]) -> tuple[int | None, int]:
    """The size of a file, None where that is not told, and a number that changes with it."""
    told = next((info[name] for name in _TELLING if info.get(name)), "")
    told = str(told.timestamp() if hasattr(told, "timestamp") else told)
    return info.get("size"), int.from_bytes(hashlib.sha256(told.encode()).digest()[:4]) >> 1
