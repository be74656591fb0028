"""What was left out or set aside stands in every file of every format."""

from dataclasses import replace

import pytest
import yaml

from calib.effects import load_effects
from calib.exporters import FORMATS, export

from . import exports
from .test_export_rings import BY_RING, recording

LEFT_OUT = [f"s{k}:base_markers" for k in (1, 2)]
MANY = [*LEFT_OUT, *(f"t{k}:rod" for k in range(30))]


def spoilt(folder, lidar):
    """A run that set a scan aside."""
    run = exports.found_by_chance([recording(folder / "rec", lidar)], load_effects([*BY_RING]))
    return replace(run, summary=run.summary | {"set_aside": {"s3:scan": "0/3"}})


@pytest.mark.parametrize("lidar", ["hesai_pandarqt64", "ouster_os0_32"])
def test_every_format_says_what_was_left_out(tmp_path, lidar, monkeypatch):
    run = spoilt(tmp_path, lidar)
    # Not in its model.yaml: the recording, which is read again, has no such things.
    monkeypatch.setattr(type(run), "left_out", property(lambda self: MANY))
    done = export(run, tmp_path / "out")
    maker = lidar.partition("_")[0]
    assert done.not_held.keys() >= {*FORMATS} - {"hesai", "ouster"} | {maker}
    for file in done.files:
        if file.name == "hesai_angle_correction.csv":  # as its maker reads it: no comments
            continue
        text = file.read_text()
        for token in (*MANY, "s3:scan"):
            assert token in text, (file.name, token)
        said = text.index("Left out:")
        assert said < text.index("s1:base_markers") < len(text), file.name
    if maker == "hesai":
        (said,) = [s for s in done.not_held["hesai"] if s.startswith("warnings: ")]
        assert "s3:scan" in said and all(token in said for token in MANY)
    provenance = yaml.safe_load((tmp_path / "out/extrinsics.yaml").read_text())["provenance"]
    assert provenance["left_out"] == MANY and provenance["set_aside"] == ["s3:scan"]


def test_nothing_is_said_where_nothing_was_left_out(tmp_path):
    run = exports.found_by_chance(
        [recording(tmp_path / "rec", "hesai_pandarqt64")], load_effects([*BY_RING])
    )
    done = export(run, tmp_path / "out")
    assert not any("Left out:" in file.read_text() for file in done.files)
    assert not any(s.startswith("warnings") for said in done.not_held.values() for s in said)
