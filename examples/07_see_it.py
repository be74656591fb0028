"""A study for a colleague who was not there: one page, and the one figure that goes into the paper.

A simulated rig whose ranges grow with incidence is fitted without knowing it, diagnosed, fitted
again with the effect that was found, and reported. The page needs nothing but itself: no network,
no program. It has the verdict on top, with a light that says whether to use the result; the ladder
of errors down to the expected one; the chain with how far every link is from CAD; residuals along
every covariate before and after, with bands that count stops and surfaces and not points; and what
the data could not tell, with what would have to be measured.

In a terminal: `rigcal report RUN -o report.html`, `rigcal plot RUN --list`, and
`rigcal plot RUN NAME -o FILE.png` (or .svg, .pdf).

    python examples/07_see_it.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import calib
from calib.report import Evidence, plot, report
from calib.simulation import load_spec

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="rigcal-"))
small = {"room": "box", "locations": 3, "stops_per_location": 2, "column_step": 200}
spec = load_spec("tiny").model_copy(update=small)
calib.simulate(spec, out / "recording", seed=1, hide={"incidence_angle_bias": 3.0})

run = calib.fit([out / "recording"], out / "first")
diagnosis = calib.diagnose(run)
grown = calib.add(run, diagnosis.worth_adding, out / "grown")
calib.diagnose(grown)

for each, page in ((run, out / "first.html"), (grown, out / "grown.html")):
    written = report([each], page)
    print(f"{page.name}: {written.verdict.light}, {written.verdict.sentence}")
    print(*(f"  because {reason}" for reason in written.verdict.reasons), sep="\n")

print("what its figures say")
for chart in written.contents.charts[:3]:
    print(f"  {chart.id}: {chart.title}")

chart = plot(Evidence.of([grown]), "residual-incidence", out / "incidence.png")
print(f"incidence.png: {chart.title}")
