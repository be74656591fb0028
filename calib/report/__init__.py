"""A run for a colleague who was not there: ``rigcal report``, ``rigcal plot`` for one figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib import outputs
from calib.linear.parallel import one_blas_thread
from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts import ON_REQUEST, SECTIONS
from calib.report.evidence import Evidence
from calib.report.numbers import blocks_of, figure_csv, figure_places
from calib.report.page import Drawn, Section, render
from calib.results.stages import REPORT, staged
from calib.runs.run import Run
from calib.show.verdict import Verdict, judge
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.documents import nearest

if TYPE_CHECKING:
    from calib.report.plots import Figure

__all__ = ["Evidence", "WrittenReport", "charts_of", "figure", "listed", "plot", "report"]


PAGES = (".html", ".htm")


@dataclass(frozen=True)
class ReportContents:
    """The figures of a run, by section, and those that it does not have."""

    sections: dict[str, list[Chart]]
    absent: list[Absent]

    @property
    def charts(self) -> list[Chart]:
        return [chart for charts in self.sections.values() for chart in charts]


@dataclass(frozen=True)
class WrittenReport:
    """A report as written."""

    file: Path
    verdict: Verdict
    contents: ReportContents

    @property
    def summary(self) -> str:
        """What was written, in short."""
        return f"{self.verdict.light}, {len(self.contents.charts)} figures"

    def document(self) -> dict[str, Any]:
        """As ``rigcal report --json`` gives it."""
        return {
            "file": str(self.file),
            "light": self.verdict.light,
            "verdict": self.verdict.sentence,
            "reasons": self.verdict.reasons,
            "charts": [chart.document() for chart in self.contents.charts],
            "left_out": [{"id": a.id, "why": a.why} for a in self.contents.absent],
        }


@one_blas_thread
def charts_of(evidence: Evidence) -> ReportContents:
    """Every figure that a run has; none is drawn yet.

    Raises:
        InputError: residuals are missing, or of another version.
    """
    sections: dict[str, list[Chart]] = {}
    absent: list[Absent] = []
    for title, makers in SECTIONS.items():
        results = [each for make in makers for each in make(evidence)]
        sections[title] = [each for each in results if isinstance(each, Chart)]
        absent += [each for each in results if isinstance(each, Absent)]
    return ReportContents(sections, absent)


@one_blas_thread
def listed(evidence: Evidence) -> list[Chart]:
    """Every figure that can be asked for by name; errors as of `charts_of`."""
    alone = (each for make in ON_REQUEST for each in make(evidence))
    return [*charts_of(evidence).charts, *(each for each in alone if isinstance(each, Chart))]


@one_blas_thread
def report(
    runs: Sequence[Run],
    out: Path | str,
    progress: Progress = lambda what, done, total: None,
) -> WrittenReport:
    """Write a page about runs: the last rung of their ladder, and how it was reached.

    Args:
        runs: one run, whose whole ladder is shown as far as it is there; or those to show.
        out: the HTML file, which needs nothing beside it.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: a recording has moved or changed, a run is incomplete or of another version, or
            the file cannot be written.
    """
    if Path(out).suffix.lower() not in PAGES:
        raise InputError(f"{out}: a report is a page of HTML; name the file so, {PAGES[0]}")
    with outputs.file(out, _inputs(runs)) as file:
        progress = staged(progress, REPORT)
        evidence = Evidence.of(runs, progress)
        contents = charts_of(evidence)
        verdict = judge(evidence.run, evidence.diagnosis)
        done, total, sections = 0, len(contents.charts), []
        for title, charts in contents.sections.items():
            drawn = []
            for chart in charts:
                progress("drawing", done, total)
                picture = chart.figure()
                svg = plots.svg(picture, chart.id)
                blocks = blocks_of(picture)
                drawn.append(Drawn(chart, svg, figure_csv(blocks), figure_places(blocks)))
                done += 1
            sections.append(Section(title, drawn, brief=verdict.light != "green"))
        page = render(evidence, verdict, sections, contents.absent)
        file.write_text(page, encoding="utf-8")
    return WrittenReport(Path(out), verdict, contents)


@one_blas_thread
def figure(evidence: Evidence, name: str) -> Figure:
    """One figure, for matplotlib; arguments and errors as of `plot`."""
    return plots.warned(_find(evidence, name).figure(), evidence.run.warning)


@one_blas_thread
def plot(evidence: Evidence, name: str, out: Path | str) -> Chart:
    """Write one figure as the end of the path says: .png, .svg or .pdf.

    Args:
        evidence: of the run.
        name: the figure's id.
        out: the file.

    Raises:
        InputError: there is no such figure, or not for this run, or not in that format.
    """
    refuse_figure([evidence.run], out)
    with outputs.file(out) as file:
        chart = _find(evidence, name)
        plots.save(chart.figure(), file, evidence.run.warning)
    return chart


def refuse_figure(runs: Sequence[Run], out: Path | str) -> None:
    """Raise InputError for a file that a figure of these runs is not to be written to."""
    plots.check_format(out)
    outputs.refuse(out, None, _inputs(runs))


def _inputs(runs: Sequence[Run]) -> list[Path]:
    return [path for run in runs for path in (run.folder, *run.inputs)]


def _find(evidence: Evidence, name: str) -> Chart:
    """The figure of that name; none behind it is looked at."""
    known = []
    for make in chain(*SECTIONS.values(), ON_REQUEST):
        for each in make(evidence):
            if each.id == name and isinstance(each, Chart):
                return each
            if each.id == name:
                raise InputError(f"{evidence.run.folder} has no figure '{name}': {each.why}")
            known += [each.id] if isinstance(each, Chart) else []
    raise InputError(f"there is no figure '{name}'{nearest(name, known)}")
