"""Inference: the only package that knows about error, probability and results.

What a script or a notebook needs is here by name, `calib.fit` say; each is loaded when it is first
used. Rooms have other names than these: importing one would put it in their place.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.evaluation import evaluate
    from calib.evaluation.apply import apply
    from calib.evaluation.arm import Arm
    from calib.exporters import export
    from calib.planning import plan
    from calib.problem.model import Model
    from calib.rig.recording import Recording
    from calib.runs.add import add
    from calib.runs.asked.moved import moved
    from calib.runs.calibrate import calibrate as fit
    from calib.runs.diagnose import diagnose
    from calib.runs.explain import explain
    from calib.runs.run import Run
    from calib.show.notebook import ProgressLine
    from calib.simulation import simulate

__all__ = [
    "Arm",
    "Model",
    "ProgressLine",
    "Recording",
    "Run",
    "add",
    "apply",
    "diagnose",
    "evaluate",
    "explain",
    "export",
    "fit",
    "moved",
    "plan",
    "simulate",
]

_HOME = {
    "Arm": "calib.evaluation.arm:Arm",
    "Model": "calib.problem.model:Model",
    "ProgressLine": "calib.show.notebook:ProgressLine",
    "Recording": "calib.rig.recording:Recording",
    "Run": "calib.runs.run:Run",
    "add": "calib.runs.add:add",
    "apply": "calib.evaluation.apply:apply",
    "diagnose": "calib.runs.diagnose:diagnose",
    "evaluate": "calib.evaluation:evaluate",
    "explain": "calib.runs.explain:explain",
    "export": "calib.exporters:export",
    "fit": "calib.runs.calibrate:calibrate",
    "moved": "calib.runs.asked.moved:moved",
    "plan": "calib.planning:plan",
    "simulate": "calib.simulation:simulate",
}
# With these come the methods of runs, and how notebooks show them.
_SHOWN = {"Run", "add", "diagnose", "explain", "fit", "moved"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    value = getattr(import_module(module), attribute)
    if name in _SHOWN:
        import_module("calib.report.methods")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
