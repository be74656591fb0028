"""Commands on a recording by URL write what they write on the same folder, whoever works on stops.

On S3 as a local server of moto has it, and from a web server.
"""

import json
import os
import re
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from chains import remote

from .programs import LIMIT_S, ROOT, execute
from .test_executors import PROGRAM, simulated

COMMANDS = (
    "fit {rec} -o run --hold-out none --workers 2",
    "add run range_scale -o grown",
    "evaluate run -o evaluated --workers 2",
    "apply run {rec} -o corrected --workers 2",
    "reproduce run",
)
PATHS = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("remote"))


def written(recording, folder, **environment):
    """What the commands write in a folder, but for where the recording is and how long it took."""
    folder.mkdir()
    lines = [line.format(rec=recording) for line in COMMANDS]
    done = execute(
        [sys.executable, "-c", PROGRAM, *lines], folder, 4 * LIMIT_S,
        PYTHONPATH=PATHS, RIGCAL_CACHE=str(folder / "cache"), **environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "identical" in done.stdout
    outputs = ("run", "grown", "evaluated", "corrected")
    files = [path for out in outputs for path in (folder / out).rglob("*") if path.is_file()]
    gone = rb'^ "seconds": [0-9.e-]+,?\n|path: [^,]*, rig|: [^ ]*_sha256'
    return {
        str(path.relative_to(folder)): re.sub(gone, b"", path.read_bytes(), flags=re.M)
        for path in files
    }


@pytest.fixture(scope="module")
def expected(recording, tmp_path_factory):
    return written(recording, tmp_path_factory.mktemp("local") / "here")


def same(found, expected):
    assert found.keys() == expected.keys() and len(found) > 20
    assert [name for name in found if found[name] != expected[name]] == []


@pytest.mark.long
def test_a_recording_on_s3_is_the_folder_that_was_put_there(recording, expected, tmp_path):
    server = pytest.importorskip("moto.server", reason="moto is not installed: no S3 is tried")
    pytest.importorskip("s3fs", reason="the extra 'remote' is not installed: no S3 is tried")
    import s3fs

    moto = server.ThreadedMotoServer(port=0, verbose=False)
    moto.start()
    try:
        host, port = moto.get_host_and_port()
        keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}
        where = {**keys, "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_REGION": "us-east-1"}
        files = s3fs.S3FileSystem(key="test", secret="test", endpoint_url=where["AWS_ENDPOINT_URL"])
        files.mkdir("lab")
        files.put(str(recording), "lab/rec", recursive=True)
        same(written("s3://lab/rec", tmp_path / "there", **where), expected)
        model = (tmp_path / "there/run/model.yaml").read_text()
        assert "s3://lab/rec" in model and str(tmp_path) not in model

        words = [sys.executable, "-c", PROGRAM, "fit s3://lab/none -o never"]
        done = execute(words, tmp_path, LIMIT_S, PYTHONPATH=PATHS, **where)
        assert "rigcal: s3://lab/none: nothing is there; give the URL of a rec" in done.stderr
    finally:
        moto.stop()


@pytest.mark.long
def test_a_recording_of_a_web_server_is_the_folder_that_it_shows(recording, expected, tmp_path):
    pytest.importorskip("aiohttp", reason="the extra 'remote' is not installed: no HTTP is tried")
    quiet = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=recording.parent))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        url = f"http://127.0.0.1:{server.server_address[1]}/rec"
        same(written(url, tmp_path / "there"), expected)
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.long
def test_a_recording_by_a_file_url_is_that_folder(recording, expected, tmp_path):
    pytest.importorskip("fsspec", reason="the extra 'remote' is not installed")
    same(written(f"file://{recording}", tmp_path / "there"), expected)


def test_check_reads_a_url(recording, rigcal, tmp_path, monkeypatch):
    pytest.importorskip("fsspec", reason="the extra 'remote' is not installed")
    monkeypatch.setenv("RIGCAL_CACHE", str(tmp_path / "cache"))
    here, there = (rigcal("check", where, "--json") for where in (recording, f"file://{recording}"))
    assert here[0] == there[0] == 0
    assert json.loads(here[1])["contents"] == json.loads(there[1])["contents"]
    assert remote.place(f"file://{recording}").is_relative_to(Path(tmp_path / "cache").resolve())
