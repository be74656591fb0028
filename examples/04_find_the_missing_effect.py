"""A fit looks fine and predicts badly. Which physical effect is missing from its model?

The fit itself gives no alarm: its error is below what is expected, as rings, mounts and surfaces of
the room absorb what the model lacks. Held-out stops show it: there the error is several times the
expected one. The diagnosis tests every effect of the catalogue beside the model, names the one that
the data ask for, says how sure it is and what else could look alike, and what adding it would do to
the held-out error. `calib.add` then adds it, starting from the fit that there is, and a second
diagnosis has nothing left to say.

In a terminal: `rigcal fit`, `rigcal diagnose`, `rigcal add`, `rigcal compare`; or all of them at
once, as often as it pays, with `rigcal explain`.

    python examples/04_find_the_missing_effect.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import calib
from calib.simulation import load_spec


def errors(run: calib.Run) -> str:
    """The error of stops that a run saw, of those that it did not, and what is expected."""
    rms = run.summary["rms_mm"]
    seen = f"{rms['fit']:.2f} mm seen, {rms['held_out']:.2f} mm held out"
    return f"{run.folder.name}: {seen}, expected {rms['noise_floor']:.2f} mm"


out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
small = {"room": "box", "locations": 3, "stops_per_location": 2, "column_step": 200}
spec = load_spec("tiny").model_copy(update=small)
calib.simulate(spec, out / "recording", seed=1, hide={"incidence_angle_bias": 3.0})

run = calib.fit([out / "recording"], out / "first")
print(errors(run))

diagnosis = calib.diagnose(run)
print(*diagnosis.sentences, sep="\n")
for candidate in diagnosis.candidates[:4]:
    explains, p = candidate["unabsorbed_rms_mm"], candidate["p_adjusted"]
    print(f"  {candidate['effect']:22} explains {explains:.2f} mm, p = {p:.1g}")

grown = calib.add(run, diagnosis.worth_adding, out / "grown")
print(errors(grown))
for name in diagnosis.worth_adding:
    effect = grown.solution.shared.effects[name]
    print(f"{name}: {1e3 * effect.estimate[0]:+.2f} ± {1e3 * effect.sigma[0]:.2f} mm")

again = calib.diagnose(grown)
print(again.sentences[0])
