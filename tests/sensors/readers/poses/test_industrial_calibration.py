"""Measurements of ROS-Industrial's industrial_calibration."""

import numpy as np
import pytest
import yaml

from chains.errors import InputError
from sensors.readers.base import Options
from sensors.readers.poses.industrial_calibration import read_industrial_calibration
from sensors.stops import POSE

POSES = [dict(zip(POSE, [0.1, 0.2, 0.3 + k, 0.5, 0.5, -0.5, 0.5], strict=True)) for k in range(3)]
ROWS = {
    str(1000 + 10 * k): {"camera_joints": [], "pose": POSES[k], "target_joints": [0.1 * k, 0.2]}
    for k in (2, 0, 1)
}


def read(path, rows, **options):
    path.write_text(rows if isinstance(rows, str) else yaml.safe_dump(rows))
    return read_industrial_calibration([path], Options(**options), lambda *a: None)


def test_stops_are_in_the_order_of_time(tmp_path):
    stops = read(tmp_path / "m.yaml", ROWS, joints={"p": "revolute", "q": "revolute"}).stops
    assert stops["time_s"].tolist() == [1000, 1010, 1020]
    np.testing.assert_allclose(stops["p"], [0, 0.1, 0.2])
    np.testing.assert_allclose(stops["target.z"], [0.3, 1.3, 2.3])


@pytest.mark.parametrize(
    ("rows", "options", "said"),
    [
        ("[]", {}, "a mapping of times"),
        ({"1": {"pose": POSES[0]}}, {}, "needs target_joints"),
        ({"x": ROWS["1000"]}, {}, "no time"),
        ({"1": {**ROWS["1000"], "camera_joints": [1.0]}}, {}, "must stand still"),
        (ROWS, {"joints": {"p": "revolute"}}, "has 2 joints, and the arm 1"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, rows, options, said):
    with pytest.raises(InputError, match=said):
        read(tmp_path / "m.yaml", rows, **options)
