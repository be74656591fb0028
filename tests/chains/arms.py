"""Arms of many kinds, by the tables of Denavit and Hartenberg that makers and textbooks print.

Rows are (a m, alpha rad, d m, theta rad), P before a joint that slides. UR: Universal Robots'
support pages; iiwa 7, IRB 120, KR 6, Panda (modified rows): the makers' data sheets; Puma and the
Stanford arm: Corke, Robotics Toolbox; SCARA and gantry as such machines are drawn.
"""

from math import pi

from chains.arm import read_arm
from chains.readers.dh import DhRow, to_urdf

H = pi / 2
TABLES = {
    "ur10": [
        (0, H, 0.1273, 0),
        (-0.612, 0, 0, 0),
        (-0.5723, 0, 0, 0),
        (0, H, 0.163941, 0),
        (0, -H, 0.1157, 0),
        (0, 0, 0.0922, 0),
    ],
    "ur5e": [
        (0, H, 0.1625, 0),
        (-0.425, 0, 0, 0),
        (-0.3922, 0, 0, 0),
        (0, H, 0.1333, 0),
        (0, -H, 0.0997, 0),
        (0, 0, 0.0996, 0),
    ],
    "iiwa7": [
        (0, -H, 0.34, 0),
        (0, H, 0, 0),
        (0, H, 0.4, 0),
        (0, -H, 0, 0),
        (0, -H, 0.4, 0),
        (0, H, 0, 0),
        (0, 0, 0.126, 0),
    ],
    "irb120": [
        (0, -H, 0.29, 0),
        (0.27, 0, 0, -H),
        (0.07, -H, 0, 0),
        (0, H, 0.302, 0),
        (0, -H, 0, 0),
        (0, 0, 0.072, pi),
    ],
    "kr6": [
        (0.025, -H, 0.4, 0),
        (0.315, 0, 0, 0),
        (0.035, -H, 0, -H),
        (0, H, 0.365, 0),
        (0, -H, 0, 0),
        (0, 0, 0.08, 0),
    ],
    "panda": [
        (0, 0, 0.333, 0),
        (0, -H, 0, 0),
        (0, H, 0.316, 0),
        (0.0825, H, 0, 0),
        (-0.0825, -H, 0.384, 0),
        (0, H, 0, 0),
        (0.088, H, 0.107, 0),
    ],
    "puma560": [
        (0, H, 0, 0),
        (0.4318, 0, 0, 0),
        (0.0203, -H, 0.15005, 0),
        (0, H, 0.4318, 0),
        (0, -H, 0, 0),
        (0, 0, 0, 0),
    ],
    "stanford": [
        (0, -H, 0.412, 0),
        (0, H, 0.154, 0),
        ("P", 0, 0, 0.3, -H),
        (0, -H, 0, 0),
        (0, H, 0, 0),
        (0, 0, 0.263, 0),
    ],
    "scara": [(0.325, 0, 0.387, 0), (0.275, pi, 0, 0), ("P", 0, 0, 0.1, 0), (0, 0, 0.05, 0)],
    "gantry": [
        ("P", 0, H, 0.5, H),
        ("P", 0, H, 0.6, H),
        ("P", 0, 0, 0.4, 0),
        (0, -H, 0.1, 0),
        (0, H, 0, 0),
        (0, 0, 0.08, 0),
    ],
    "positioner": [(0, H, 0.5, 0), (0, 0, 0.2, 0)],
}
MODIFIED = ("panda",)


def rows_of(name: str) -> list[DhRow]:
    """The rows of one arm, its links weighing alike."""
    rows = []
    for i, row in enumerate(TABLES[name], start=1):
        kind = "prismatic" if row[0] == "P" else "revolute"
        lower, upper = (-0.3, 0.3) if kind == "prismatic" else (-2.6, 2.6)
        numbers = dict(zip(("a_m", "alpha_rad", "d_m", "theta_rad"), row[-4:], strict=True))
        rows.append(
            DhRow(name=f"j{i}", kind=kind, lower=lower, upper=upper, mass_kg=3.0, **numbers)
        )
    return rows


def write_arm(folder, name):
    """Write the arm's URDF into a folder; return its path."""
    path = folder / f"{name}.urdf"
    path.write_text(to_urdf(name, rows_of(name), modified=name in MODIFIED))
    return path


def edges_of(folder, name):
    """The arm's edges, from arm_base to arm_end."""
    return read_arm(write_arm(folder, name), "arm_base", "arm_end")
