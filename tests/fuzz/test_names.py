"""Names that people never give, in every place of a recording and over every command.

Nothing is written outside of what a command was asked to write, and what it says is a result or
one sentence.
"""

import itertools
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from calib.cli import main
from chains.errors import LONGEST_NAME, is_file_name
from sensors.numbers import read_csv

from ..calib import rigs
from ..sensors.readers.clouds.test_files import TABLE

NAMES = (
    "../../x", "/etc/x", "../" * 12 + "rigcal-escaped", "/tmp/rigcal-escaped", "a/b", "a\\b",
    "..", ".", "", " ",
    "con", "nul.txt", "two\nlines", "nul\0byte", "\x1b[31mred", "'", '"', "`x`", "$(touch x)",
    "a;b", "a,b", "a: b", "ünï 😀", "x" * 5000, "<script>alert(1)</script>", "=cmd()", "-rf",
    "--out", "_tracker", "{x}", "%s", "%2e%2e", "~", "*", "a=b", "null", "1", "NaN", "&amp;",
)  # fmt: skip
# Where a name stands: in which file, and how it is put there.
PLACES = ("rig", "stop", "location", "frame", "body", "joint", "column", "label")
COMMANDS = ("check", "fit", "compare", "evaluate", "export", "apply", "diagnose", "plot")


def renamed(folder: Path, place: str, name: str) -> Path:
    """A recording with a hostile name in one place."""
    rec = rigs.write(folder / "rec", seed=4)
    rig = yaml.safe_load((rec / "rig.yaml").read_text())
    table = {k: v.tolist() for k, v in read_csv(rec / "stops.csv", ("stop", "location")).items()}
    if place == "rig":
        rig["name"] = name
    elif place == "stop":
        old, table["stop"][1] = table["stop"][1], name
        (rec / "scans" / f"{old}.parquet").rename(rec / "scans" / "odd.parquet")
        if is_file_name(name) and name == os.path.basename(name):
            (rec / "scans" / "odd.parquet").rename(rec / "scans" / f"{name}.parquet")
    elif place == "location":
        table["location"][0] = name
    elif place == "frame":
        rig["frames"] = {name if k == "mount" else k: v for k, v in rig["frames"].items()}
        for frame in rig["frames"].values():
            frame["parent"] = name if frame["parent"] == "mount" else frame["parent"]
    elif place == "body":
        rig["frames"][name] = rig["frames"].pop("mount_markers")
        rig["tracker"]["bodies"] = ["base_markers", name]
        table = {k.replace("mount_markers.", f"{name}."): v for k, v in table.items()}
    elif place == "joint":
        text = (rec / "arm.urdf").read_text()
        safe = name.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
        safe = re.sub(r"[^\t\n\x20-\U0010ffff]", "?", safe)
        (rec / "arm.urdf").write_text(text.replace('"lift"', f'"{safe}"'))
        table = {safe if k == "lift" else k: v for k, v in table.items()}
    elif place == "column":
        table[name] = list(np.arange(len(table["stop"])) * 1.5)
    else:
        label = rec / "reference" / "labels.yaml"
        label.parent.mkdir(exist_ok=True)
        label.write_text(yaml.safe_dump({0: name}))
        rig["reference"]["labels"] = "reference/labels.yaml"
    (rec / "rig.yaml").write_text(yaml.safe_dump(rig, allow_unicode=True))
    cells = [",".join(map(quoted, row)) for row in zip(*table.values(), strict=True)]
    (rec / "stops.csv").write_text("\n".join([",".join(map(quoted, table)), *cells]))
    return rec


def quoted(cell: object) -> str:
    text = "" if cell != cell else str(cell)
    return '"' + text.replace('"', '""') + '"' if re.search(r'[,"\n]', text) else text


def run(arguments: list[object], monkeypatch, capfd) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["rigcal", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, *capfd.readouterr()


def outside(folder: Path) -> set[str]:
    """What is there beside the folders that commands were told to write: round the recording, in
    the working folder, and where hostile names point."""
    around = [p for base in (folder, folder.parent, Path.cwd()) for p in base.iterdir()]
    names = ("/rigcal-escaped", "/tmp/x", *(name for name in NAMES if name.startswith("/")))
    aimed = [Path(name + ending) for name in names for ending in ("", ".parquet", ".urdf")]
    return {str(p) for p in (*around, *filter(Path.exists, aimed)) if p.name not in ("out", "rec")}


def commands(rec: Path, out: Path) -> dict[str, list[object]]:
    scan = next(iter((rec / "scans").glob("*.parquet")), rec)
    made = out / "run"
    return {
        "check": [rec],
        "fit": [rec, "-o", made, "--effects", "ring_range_offset", "--hold-out", "none"],
        "compare": [made],
        "evaluate": [made],
        "export": [made, "-o", out / "export"],
        "apply": [made, scan, "-o", out / "apply"],
        "diagnose": [made, "--no-refits"],
        "plot": [made, "--list"],
    }


def looked_at(rec, tmp_path, monkeypatch, capfd, chosen) -> list[str]:
    """What every command did wrong with a recording."""
    before, wrong = outside(tmp_path), []
    for command, arguments in commands(rec, tmp_path / "out").items():
        if command not in chosen:
            continue
        code, out, err = run([command, *arguments], monkeypatch, capfd)
        if code not in (0, 2, 3) or "Traceback" in out + err or "internal fault" in err:
            wrong.append(f"{command}: exit {code}: {err[-300:]!r}")
        if code == 2 and not out and not err.startswith("rigcal: "):
            wrong.append(f"{command}: says {err[:200]!r}")
        if code == 2 and command == "fit":
            break
    return wrong + [f"wrote {path}" for path in sorted(outside(tmp_path) - before)]


@pytest.mark.parametrize("place", PLACES)
def test_names_lead_nowhere(place, tmp_path, monkeypatch, capfd):
    """A name for each place, another one for each: all of them with -m long."""
    name = NAMES[PLACES.index(place)]
    (tmp_path / "n").mkdir()
    rec = renamed(tmp_path / "n", place, name)
    chosen = ("check", "fit", "evaluate" if place == "location" else "export")
    assert not looked_at(rec, tmp_path / "n", monkeypatch, capfd, chosen), name


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_no_name_leads_anywhere(place, tmp_path, monkeypatch, capfd):
    for k, name in enumerate(NAMES):
        folder = tmp_path / f"n{k}"
        folder.mkdir()
        rec = renamed(folder, place, name)
        whole = k % len(PLACES) == PLACES.index(place)  # every command for a share of the names
        chosen = COMMANDS if whole else ("check", "fit", "export")
        assert not looked_at(rec, folder, monkeypatch, capfd, chosen), (place, name)


def test_names_of_files_are_told_apart():
    """By what a file system does with them, not by the rule under test."""
    for name in (*NAMES, *map("".join, itertools.product("./\\_-a\n", repeat=3))):
        if is_file_name(name):
            assert os.path.basename(f"scans/{name}.parquet") == f"{name}.parquet"
            assert os.path.normpath(f"scans/{name}.parquet") == f"scans/{name}.parquet"
            assert len(os.fsencode(f"{name}.0.{name}.parquet")) < 255
    assert all(map(is_file_name, ("L00P00", "s 1", "Größe", "a.b", "1", "x" * LONGEST_NAME)))


def test_an_import_writes_the_arm_into_the_recording(tmp_path, monkeypatch, capfd):
    (tmp_path / "rig").mkdir()
    rec = rigs.write(tmp_path / "rec", seed=4)
    rig = yaml.safe_load((rec / "rig.yaml").read_text())
    for name in ("../../stolen.urdf", str(tmp_path / "stolen.urdf")):
        rig["arm"]["urdf"] = name
        (tmp_path / "rig" / "rig.yaml").write_text(yaml.safe_dump(rig))
        (tmp_path / "log.csv").write_text((rec / "stops.csv").read_text())
        given = ["table", tmp_path / "log.csv", "urdf", rec / "arm.urdf", "--rows", "stops"]
        given += ["--base", "arm_base", "--tip", "arm_end", "--rig", tmp_path / "rig" / "rig.yaml"]
        code, _, err = run(["import", *given, "-o", tmp_path / "new"], monkeypatch, capfd)
        assert code == 2 and "arm.urdf is" in err, err
        assert not (tmp_path / "stolen.urdf").exists() and not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["../../x", "/tmp/rigcal-escaped", ".x", "_x", "x" * 300])
def test_an_import_names_no_scan_after_such_a_stop(name, tmp_path, monkeypatch, capfd):
    """Clouds without a clock are given to the stops of a table, and written under their names."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "t.csv").write_text(f'stop,q1,x\n"{name}",0,1\nk,0.5,2\n')
    for cloud in ("a.bin", "b.bin"):
        TABLE[:, :4].tofile(tmp_path / cloud)
    before = outside(tmp_path)
    given = ["table", tmp_path / "t.csv", "kitti", tmp_path / "a.bin", tmp_path / "b.bin"]
    given += ["--rows", "stops", "--lidar", "velodyne_vlp16", "--rings-from-elevation"]
    code, _, err = run(["import", *given, "-o", tmp_path / "deep" / "out"], monkeypatch, capfd)
    assert code == 2 and "is no name for a file" in err, err
    assert outside(tmp_path) == before and not list((tmp_path / "deep").iterdir())
