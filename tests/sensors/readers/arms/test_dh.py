"""Tables of Denavit and Hartenberg in files: the same arm however it is written."""

import numpy as np
import pytest

from chains.arm import read_arm
from chains.errors import InputError
from chains.frames import FrameTree
from chains.readers.dh import DhRow, to_urdf
from sensors.readers.arms.dh import read_dh
from sensors.readers.base import Options

ROWS = (DhRow("j1", 0.1, np.pi / 2, 0.4), DhRow("j2", -0.6, 0, 0.05, theta_rad=np.pi / 4))
WRITTEN = {
    "a.yaml": """\
convention: standard
joints: [{name: j1, a: 0.1, alpha: 1.5707963267948966, d: 0.4},
         {name: j2, a_mm: -600, alpha_deg: 0, d_cm: 5, theta_deg: 45}]
""",
    "b.csv": "joint;a [mm];alpha;d [mm];offset;convention\n"
    "j1;100;90;400;0;standard\nj2;-600,0;0;50;45;standard\n",
    "c.csv": "name,a_m,alpha_rad,d_m,theta_rad\nj1,0.1,1.5707963267948966,0.4,\n"
    "j2,-0.6,0,0.05,0.7853981633974483\n",
}


def quiet(what, done, total):
    pass


def tips(folder, urdf):
    (folder / "arm.urdf").write_text(urdf)
    tree = FrameTree(read_arm(folder / "arm.urdf", "arm_base", "arm_end"))
    return tree.place("arm_end", np.array([[0.0, 0.0], [0.3, -1.1]])).Ts_root_frame


@pytest.mark.parametrize("name", WRITTEN)
def test_units_and_formats_make_one_arm(tmp_path, name):
    (tmp_path / name).write_text(WRITTEN[name])
    found = read_dh([tmp_path / name], Options(dh="standard"), quiet)
    expected = tips(tmp_path, to_urdf("x", ROWS, False))
    np.testing.assert_allclose(tips(tmp_path, found.arm.urdf), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joints: [{a: 0, alpha: 0, d: 0.1}]", "--dh standard"),
        ("{convention: craig, joints: [{a: 0, alpha: 0, d: 0.1}]}", "craig"),
        ("{convention: modified, joints: [{a: 0, alpha: 0}]}", "row 1: d is missing"),
        ("{convention: modified, joints: [{a: 612, alpha: 0, d: 0}]}", "millimetres; say a_mm"),
        ("{convention: modified, joints: [{a: x, alpha: 0, d: 0}]}", "a is 'x'"),
        ("{convention: modified, joints: [{a: 0, alfa: 0, d: 0}]}", "did you mean alpha"),
        ("{convention: modified}", "a list `joints`"),
        ("{convention: modified, joints: [{a: 0, alpha: 0, d: 0, type: screw}]}", "type is screw"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, text, said):
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_dh([path], Options(), quiet)
