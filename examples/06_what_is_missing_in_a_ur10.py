"""A real arm repeats ten times better than its geometric model fits it. What is missing?

A UR10 under a laser tracker: 11,911 poses (series A) and 632 others (series D) by Landgraf et al.,
CASE 2021, https://github.com/christianlandgraf/ipa-robot-accuracy (MIT licence); DATA is the folder
in which its `Series_A` and `Series_D` are. The same pose repeats to 0.06 mm; with all lengths,
zeros and tilts of joints fitted, held-out poses are off by 0.45 mm rms in A and 0.49 mm in D.

In both series the diagnosis names `arm_gravity_sag` and `arm_gear_error@17`, an error that repeats
17 times a turn, and gives a formula for what is left: example 9. By the gear order lift errs by
0.28 mrad in A and 0.21 in D, the elbow by 0.25 and 0.24, with the same signs. One whole number in
every joint is what an encoder or a motor would do; which of the two, these data do not say. Lift
and elbow give way by 9 and 16 microrad per N m in A, by 10 and 19 in D.

What is of the arm and not of the series carries over. With the arm as A found it and only base and
tool free, D's error falls from 0.46 to 0.36 mm, below the 0.40 mm to which geometry alone can be
fitted to D itself. From D to A it falls from 0.54 to 0.44 mm.

`rigcal explain` goes on without help, by formulas, to 0.17 mm held out in A and 0.29 mm in D, and
then says that structure without a name is left. It is right: 0.17 mm is nearly three times the
repeatability. Growth with temperature is not significant (p = 0.5 in A, 0.7 in D).

    python examples/06_what_is_missing_in_a_ur10.py [FOLDER] [DATA]
"""

import sys
import tempfile
from pathlib import Path

from ur10_tmac import elsewhere, recording

import calib

GEOMETRY = calib.Model(("arm_link_length", "arm_joint_offset", "arm_axis_tilt"))
STEPS = ("arm_gravity_sag", "arm_gear_error@17", "arm_gear_error@34")


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
data = Path(sys.argv[2] if len(sys.argv) > 2 else "ur10_tmac")
if not (data / "Series_A").is_dir():
    print(f"skipped: {data} is not there; the head of this file says where the data are from")
    sys.exit()
A, D = (recording(data, series, out / series, 1000) for series in "AD")

for folder, other in ((A, D), (D, A)):
    run = calib.fit([folder], out / f"{folder.name}-geometry", GEOMETRY)
    print(f"series {folder.name}", *calib.diagnose(run, refits=False).sentences[:3], sep="\n  ")
    for step in (None, *STEPS):
        if step:
            run = calib.add(run, step, out / f"{folder.name}-{step}")
        held_out = run.summary["rms_mm"]["held_out"]
        print(f"  {step or 'geometry':17} {held_out:.3f} mm held out,", end=" ")
        print(
            f"{elsewhere(run, other).rms_mm:.3f} mm in series {other.name}, but for base and tool"
        )
