"""A formula for what no known effect explains. Is it of the arm, or of these poses?

Example 6 ends with structure without a name: after geometry, gravity sag and a gear order of 17,
held-out poses of a UR10 are off by 0.28 mm in series A, five times what the arm repeats to. Here
`diagnose` finds a formula for it in series A. The formula is kept as a file and fitted to series D,
which has other poses, of another day. Only its form is taken along: D estimates the amounts itself.

The formula is of the pan joint. It reads 0.5 mrad too little in two narrow places, from -0.97 to
-0.84 rad and around -0.65 rad, and has a small wave of eight periods a turn. The error of held-out
poses falls from 0.28 to 0.23 mm. In series D both places come out again, at 0.43 ± 0.05 and
0.56 ± 0.04 mrad, and the error falls from 0.37 to 0.33 mm. They belong to the arm. The wave does
not come out: 0.15 mrad in A, 0.03 ± 0.01 in D. It describes series A, and no more than that.

The other way there is less. D has a formula of its own, over the lift joint, with which its error
falls from 0.37 to 0.32 mm. Fitted to A it takes 0.28 to 0.26 mm. Of its four terms one has the same
amount in both, a step of 0.4 mrad where lift passes -1.78 rad; the ramp is less than half as steep
in A, and the last step is gone. By its own series alone each formula looked equally good.

DATA are those of example 6: https://github.com/christianlandgraf/ipa-robot-accuracy (MIT licence).

    python examples/09_a_formula_that_holds_elsewhere.py [FOLDER] [DATA]
"""

import sys
import tempfile
from pathlib import Path

import yaml
from ur10_tmac import recording

import calib

KNOWN = ("arm_link_length", "arm_joint_offset", "arm_axis_tilt", "arm_gravity_sag")

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
data = Path(sys.argv[2] if len(sys.argv) > 2 else "ur10_tmac")
if not (data / "Series_A").is_dir():
    print(f"skipped: {data} is not there; the head of this file says where the data are from")
    sys.exit()

runs = {}
for series in "AD":
    folder = recording(data, series, out / series, 1000)
    model = calib.Model((*KNOWN, "arm_gear_error@17"))
    runs[series] = calib.fit([folder], out / f"{series}-known", model)


def with_form(file: Path, series: str) -> list[str]:
    """Fit a formula's amounts to a series; of each term, amount and sigma in mrad."""
    grown = calib.add(runs[series], str(file), out / f"{series}-with-{file.stem}")
    before, after = (run.summary["rms_mm"]["held_out"] for run in (runs[series], grown))
    print(f"  in series {series}: {before:.3f} -> {after:.3f} mm held out")
    effect = grown.solution.shared.effects[grown.effects[-1]]
    rows = zip(1e3 * effect.estimate, 1e3 * effect.sigma, strict=True)
    return [f"{amount:+.2f} ± {sigma:.2f}" for amount, sigma in rows]


for home, other in ("AD", "DA"):
    name, formula = next(iter(calib.diagnose(runs[home]).formulas.items()))
    file = out / f"of_{home}.yaml"
    file.write_text(yaml.safe_dump(dict(formula)), encoding="utf-8")
    print(f"formula of series {home}: {name}")
    terms = zip(with_form(file, home), with_form(file, other), formula["basis"], strict=True)
    for here, there, term in terms:
        print(f"    {here} mrad in {home}, {there} in {other}: {term}")
