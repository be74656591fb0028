"""A run whose files were damaged, edited or sent by somebody: one sentence that names the file."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest

from calib.runs.calibrate import calibrate
from calib.runs.stored import read_arrays
from calib.simulation import Spec, simulate
from chains.errors import InputError

SPEC = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=2, column_step=400)
READERS = ("compare run", "export run -o out", "evaluate run -o out", "apply run rec -o out")
READERS += ("diagnose run", "add run arm_axis_tilt -o out", "report run -o out.html")
OF_STATE = READERS[2:]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    simulate(SPEC, folder / "rec", 1)
    calibrate([folder / "rec"], folder / "run", hold_out="none")
    return folder


def text(words):
    return lambda path: path.write_text(words)


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)


def spoilt(path):
    """One byte of what the archive holds of an unknown is another."""
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        entry = archive.getinfo("state/ring_range_offset.npy")
        following = [i.header_offset for i in archive.infolist()] + [archive.start_dir]
    end = min(offset for offset in following if offset > entry.header_offset)
    data[end - entry.compress_size // 2] ^= 0xFF
    path.write_bytes(data)


def header(shape, descr="<f8"):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


def huge(path):
    """An array of 8 TB, and none of its bytes; all others as they were."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    first = next(iter(members))
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, header((10**6, 10**6)) if name == first else data)


def arrays(change):
    """Change the arrays of an .npz file."""

    def apply(path):
        with np.load(path) as stored:
            found = dict(stored)
        change(found)
        np.savez(path, **found)

    return apply


def shorter(names):
    """Cut the first array of those names short."""

    def change(found):
        name = next(name for name in found if names in name and found[name].ndim)
        found[name] = found[name][:-1]

    return arrays(change)


def gone(names):
    def change(found):
        del found[next(name for name in found if names in name)]

    return arrays(change)


def beyond(found):
    name = next(name for name in found if name.startswith("met/"))
    found[name] = found[name] + 10**6


def edited(*keys, value=None):
    """Put something else where a key of a JSON document is."""

    def apply(path):
        document = json.loads(path.read_text())
        inner = document
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        path.write_text(json.dumps(document))

    return apply


DAMAGES = [
    *[("summary.json", text(words)) for words in ("{}", "[]", "", "null", "{", "[" * 10**5)],
    ("summary.json", edited("rms_mm", value={})),
    ("summary.json", edited("rms_mm", "fit", value="small")),
    ("summary.json", edited("converged", value="perhaps")),
    *[("solution.yaml", text(words)) for words in ("{}", "[]", "", "frames: {lidar: 3}", "a: [")],
    *[("model.yaml", text(words)) for words in ("{}", "[]", "recordings: []", "effects: {}")],
    *[("covariance.npz", change) for change in (text(""), text("no zip"), cut, flipped, huge)],
    ("covariance.npz", shorter("names")),
    ("covariance.npz", gone("covariance")),
]
OF_STATES = [
    *[text(""), cut, spoilt, huge, shorter("lidar"), gone("lidar"), shorter(".dofs")],
    *[gone("state/ring_range_offset"), arrays(beyond)],
]


def sentence(made, tmp_path, monkeypatch, rigcal, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = rigcal("-q", *words.split())
    assert (code, out) == (2, ""), err
    assert err.startswith("rigcal: ") and err.count("\n") == 1 and len(err) < 500
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rec", "run"]
    return err


@pytest.fixture
def damaged(made, tmp_path):
    """A function that gives the run with one of its files damaged."""

    def damage(name, change):
        shutil.copytree(made / "run", tmp_path / "run")
        (tmp_path / "rec").symlink_to(made / "rec")
        change(tmp_path / "run" / name)

    return damage


@pytest.mark.parametrize("number", range(len(DAMAGES)))
def test_a_broken_file_is_named_by_whatever_opens_the_run(
    made, damaged, tmp_path, monkeypatch, rigcal, number
):
    name, change = DAMAGES[number]
    damaged(name, change)
    words = READERS[number % len(READERS)]
    err = sentence(made, tmp_path, monkeypatch, rigcal, words)
    assert f"run/{name}" in err or name == "model.yaml", err


@pytest.mark.parametrize("number", range(len(OF_STATES)))
def test_a_broken_state_is_named_by_whatever_goes_on_from_it(
    made, damaged, tmp_path, monkeypatch, rigcal, number
):
    change = OF_STATES[number]
    damaged("state.npz", change)
    words = OF_STATE[number % len(OF_STATE)] if change.__name__ != "apply" else "diagnose run"
    assert "run/state.npz" in sentence(made, tmp_path, monkeypatch, rigcal, words)


def test_beams_that_the_state_knows_otherwise_are_named(
    made, damaged, tmp_path, monkeypatch, rigcal
):
    damaged("state.npz", shorter("met/"))
    err = sentence(made, tmp_path, monkeypatch, rigcal, "diagnose run")
    assert "state.npz" in err and "of them met" in err


@pytest.mark.parametrize("name", ["stops.csv", "rig.yaml", "scans/L00P01.parquet", "arm.urdf", ""])
def test_what_vanishes_while_it_is_read_is_named(made, tmp_path, monkeypatch, rigcal, name):
    """The folder goes away when the fit has begun: a disk is pulled, say."""
    from calib.runs import calibrate as module

    shutil.copytree(made / "rec", tmp_path / "rec")
    shutil.copytree(made / "run", tmp_path / "run")
    before = (tmp_path / "run/summary.json").read_bytes()
    build = module.problems.build

    def later(*arguments, **options):
        path = tmp_path / "rec" / name
        (shutil.rmtree if path.is_dir() else path.unlink)(*([path] if path.is_dir() else []))
        monkeypatch.setattr(module.problems, "build", build)
        return build(*arguments, **options)

    monkeypatch.setattr(module.problems, "build", later)
    monkeypatch.chdir(tmp_path)
    code, _, err = rigcal("fit", "rec", "-o", "run", "--hold-out", "none")
    if code:
        assert code == 2 and err.startswith("rigcal: ") and err.count("\n") == 1 and "rec" in err
        assert (tmp_path / "run/summary.json").read_bytes() == before
    else:  # what was read already
        assert name in ("stops.csv", "rig.yaml", "arm.urdf")


def test_arrays_are_not_believed_before_the_file_is_looked_at(tmp_path):
    path = tmp_path / "a.npz"
    for shape, descr in (((10**12,), "<f8"), ((2**62, 4), "<f8"), ((3,), "|O"), ((-1,), "<f8")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("x.npy", header(shape, descr))
        with pytest.raises(InputError, match=r"a\.npz (claims|holds|is no whole)"):
            read_arrays(path)
    np.savez(path, x=np.zeros((3, 0)), y=np.array(["é"]), z=np.float64(1))
    assert {n: x.shape for n, x in read_arrays(path).items()} == {"x": (3, 0), "y": (1,), "z": ()}
    np.savez_compressed(path, x=np.zeros(10**6))  # as much as DEFLATE can: it is no lie
    assert not read_arrays(path)["x"].any()
