"""Runs without a fit: recordings as drawn, and solutions drawn at random, for what writes them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.effects import FrameOffset, trust_in
from calib.forward import Placed, Term, place
from calib.problem.model import Model, Source
from calib.problem.unknowns import Key
from calib.results.solution import EffectEstimate, FrameEstimate, Part, Solution, one_unit
from calib.rig import Rig
from calib.runs.run import Run
from chains import se3


def found_by_chance(
    folders: Sequence[Path], effects: Sequence[object] = (), seed: int = 0, size: float = 1.0
) -> Run:
    """A run as a fit would leave it, each unknown as far off as its prior allows, times `size`.

    With several recordings, each rig has everything for itself.
    """
    rng, model = np.random.default_rng(seed), Model(tuple(effects))
    shared, own, keys, sources = Part(), {}, [], [Source.open(folder) for folder in folders]
    for source in sources:
        rig, several = source.rig, len(sources) > 1
        part = own.setdefault(rig.name, Part()) if several else shared
        before = f"{rig.name}/" if several else ""
        for effect in (*map(FrameOffset, rig.frame_sigma), *model.effects):
            params = effect.params(rig)
            if params:
                theta = size * rng.normal(0, [p.sigma for p in params])
                sigma = rng.uniform(0.1, 0.5, len(params)) * [p.sigma for p in params]
                keys += [Key(f"{before}{effect.name}", p.name) for p in params]
                _put(part, rig, effect, theta, sigma)
        if rig.tracker and rig.reference:
            T = se3.exp(rng.normal(size=6))
            part.frames[rig.reference_frame] = FrameEstimate(rig.world, T, *np.full((2, 3), 1e-4))
    root = rng.normal(0, 1e-4, (len(keys), len(keys)))
    documents = [
        {"path": str(folder), "rig": s.rig.name, "sha256": s.recording.digest()}
        for folder, s in zip(folders, sources, strict=True)
    ]
    document = {
        "recordings": documents, **model.document(), "prior": None, "versions": {"rigcal": "0.1.0"},
    }  # fmt: skip
    untold = [{"name": "mount.tz", "why": "tied to arm_link_length.tip: both change alike"}]
    summary = {
        "residual": "range",
        "converged": True,
        "rms_mm": {"fit": 3.25, "held_out": None},
    }
    solution = Solution(
        shared=shared,
        recordings=own,
        not_estimated=untold,
        keys=tuple(keys),
        covariance=root @ root.T,
    )
    trust = trust_in(model.effects)
    return Run(folders[0].parent / "run", document, summary, solution, trust=trust)


def _put(part: Part, rig: Rig, effect: object, theta: np.ndarray, sigma: np.ndarray) -> None:
    if isinstance(effect, FrameOffset):
        edge = rig.tree.edges[rig.tree.edge_names.index(effect.name)]
        T = edge.T_parent_child @ se3.exp(theta)
        part.frames[effect.name] = FrameEstimate(edge.parent, T, sigma[3:], sigma[:3])
    else:
        params = effect.params(rig)
        unit, names = one_unit([p.unit for p in params]), tuple(p.name for p in params)
        part.effects[effect.name] = EffectEstimate(unit, names, theta, sigma)


def as_fitted(
    run: Run, source: Source, frame: str, joints: np.ndarray, effects: Sequence[str]
) -> Placed:
    """T_root_frame at reported joints (K, J) as the forward model has it, with these effects.

    The frames are as found, whatever the effects.
    """
    part = run.solution.part(source.rig.name if run.solution.recordings else None)
    values, terms = {}, []
    for effect in Model.read(run.model, trust=run.trust).effects:
        if effect.name in effects:
            values[effect.name] = part.effects[effect.name].estimate
            terms.append(Term(effect, effect.name, np.arange(len(values[effect.name]))))
    tree = source.rig.tree
    for name in source.rig.frame_sigma:
        T_cad = tree.edges[tree.edge_names.index(name)].T_parent_child
        values[name] = se3.log(se3.inverse(T_cad) @ part.frames[name].T_parent_child)
        terms.append(Term(FrameOffset(name), name, np.arange(6)))
    return place(source.rig, terms, joints, {}, "root", None).in_root(frame, values)


def none_of(unit: str, names: tuple[str, ...]) -> EffectEstimate:
    """An effect whose parameters are all 0, and exact."""
    zeros = np.zeros(len(names))
    return EffectEstimate(unit=unit, names=names, estimate=zeros, sigma=zeros)
