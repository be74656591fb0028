"""Nobody has a recording; they have a log of joints, a take of Motive, clouds, a URDF, a mesh.

A simulated recording is written out as such files: joints logged in degrees while the arm goes
from stop to stop, a take of Motive with y up and in millimetres on a clock of its own, a PLY for
each stop, a list of spheres. The import finds the holds and how far the clocks are apart; the fit
of what it writes is that of the recording itself. On the command line it is

    rigcal import table joints.csv motive take.csv ply clouds/*.ply mesh room.ply \\
        spheres spheres.csv urdf arm.urdf -o imported --rig rig.yaml --angle-unit deg

    python examples/08_import_your_own_files.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from foreign_files import write_files

import calib
from calib.intake import Choices, import_files
from calib.simulation import load_spec
from chains import se3
from sensors.readers.base import Options

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
recorded, files, imported = out / "recording", out / "files", out / "imported"
spec = load_spec("tiny").model_copy(update={"occluded_share": 0.0, "sweeps": 1})
calib.simulate(spec, recorded, seed=1)
write_files(recorded, files)

given = [
    ("table", [files / "joints.csv"]),
    ("motive", [files / "take.csv"]),
    ("ply", sorted((files / "clouds").glob("*.ply"))),
    ("mesh", [files / "room.ply"]),
    ("spheres", [files / "spheres.csv"]),
    ("urdf", [files / "arm.urdf"]),
]
done = import_files(given, imported, Options(angle_unit="deg"), Choices(files / "rig.yaml"))
print(*done.understood, *(f"odd: {line}" for line in done.odd), sep="\n")

direct, of_files = (calib.fit([r], f"{r}-run", hold_out="none") for r in (recorded, imported))
for name, frame in direct.solution.shared.frames.items():
    other = of_files.solution.shared.frames[name]
    gap = se3.log(se3.inverse(frame.T_parent_child) @ other.T_parent_child)
    turn_mrad, shift_mm = (1e3 * np.linalg.norm(part) for part in (gap[:3], gap[3:]))
    sigma_mm = 1e3 * np.linalg.norm(frame.sigma_m)
    print(f"{name:14} {shift_mm:.4f} mm and {turn_mrad:.4f} mrad apart, sigma {sigma_mm:.2f} mm")
