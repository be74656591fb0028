"""You suspect an effect that the catalogue lacks: write it as a formula, or as a class, and try it.

Here the range scale goes with the humidity of the air, which `stops.csv` has as a column of its
own. A formula is arithmetic over the columns of stops and points; it is parsed, never run. A class
in a Python file does what arithmetic cannot. Either is then an effect like all others: it can be
hidden in a simulation, fitted, added to a run, diagnosed, compared.

Whether it is worth having is for the stops that were held out to say. The diagnosis of the first
fit does not know your effect, and still finds on what the error hangs: humidity, and humidity with
the range.

    python examples/05_your_own_effect.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import calib
from calib.simulation import Spec

FORMULA = """\
name: humid_air
site: range
unit: "1"
sigma: 0.01
basis: ["(humidity - 0.45) * range"]
"""
CLASS = '''\
import numpy as np
from calib.effects import Effect, Param, Site

class HumidAir(Effect):
    """Range grows with humidity: ``measured = true * (1 + a * (humidity - 0.45))``."""
    name, site, covariates = "HumidAir", Site.BEAM, ("humidity", "range_m")

    def params(self, rig):
        return (Param("amount", "1", 0.01),)
    def basis(self, view):
        range_m = np.nan_to_num(view["range_m"], posinf=0.0)  # a beam may meet nothing
        growth = (view["humidity"] - 0.45) * range_m
        return growth[:, None, None] * np.array([1.0, 0, 0])[:, None]  # range, azimuth, elevation
'''

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
(out / "mine.yaml").write_text(FORMULA)
(out / "mine.py").write_text(CLASS)
spec = Spec(
    lidar="hesai_pandarxt32", room="box", locations=4, stops_per_location=3, column_step=200
)
calib.simulate(spec, out / "recording", seed=2, hide={str(out / "mine.yaml"): 1.5})

run = calib.fit([out / "recording"], out / "without")
print(f"without: {run.summary['rms_mm']['held_out']:.2f} mm held out")
for each in calib.diagnose(run, refits=False).unexplained[:3]:
    print(f"left over: {each['rms_mm']:.2f} mm hang on {' x '.join(each['covariates'])}")
for kind in ("yaml", "py"):
    grown = calib.add(run, str(out / f"mine.{kind}"), out / f"with-{kind}")
    effect = grown.solution.shared.effects[grown.effects[-1]]
    amount = f"{effect.estimate[0]:+.4f} ± {effect.sigma[0]:.4f}"
    print(f"mine.{kind}: {grown.summary['rms_mm']['held_out']:.2f} mm held out, amount {amount}")
