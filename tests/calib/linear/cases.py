"""Problems at states near no optimum, and their rows as one dense matrix."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.effects import DEFAULT
from calib.linear.clusters import Gradients
from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.system import Linearisation
from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.problem.prior import JointPrior
from calib.simulation import Spec
from calib.solve.estimate import Estimate
from calib.solve.fit import preview
from calib.solve.graph import Graph, KeptRows

from .. import rigs, simulated
from .dense import Dense

MODEL = Model((*DEFAULT, "noise_range", "optitrack_scale", "faro_scale"))
PERFECT = {"frame": "faro", "mesh": "reference/mesh.ply", "sigma_m": 0}
PLAIN_ARM = {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end", "sigma_joint_rad": 0}
BOXES = {  # changes of rig.yaml
    "stop by stop": {"base": {"moves": "stop"}},
    "by location": {},
    "never moved, no joint noise": {"base": {"moves": "never"}, "arm": PLAIN_ARM},
    "no joint noise": {"base": {"moves": "stop"}, "arm": PLAIN_ARM},
    "no tracker": {"tracker": None, "target": None, "base": {"moves": "stop"}},
    "perfect mesh": {"reference": PERFECT},
    "no lidar": {"lidar": None},
}
SIMULATED = {
    "simulated": Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=2, column_step=128),
    "planes": Spec(mesh=False, targets=0, locations=3, stops_per_location=2, column_step=200),
}
CASES = (*BOXES, *SIMULATED, "a stop without scan", "two recordings", "an earlier estimate")


@dataclass
class Case:
    """A problem at a state near no optimum, linearised densely."""

    start: Estimate
    dense: Dense
    prior: JointPrior | None

    @property
    def held(self) -> tuple[str, ...]:
        return self.prior.variables if self.prior else ()

    @property
    def weighted(self) -> bool:
        """Whether any rows that are no beams have lost weight."""
        blocks, unknowns = self.start.problem.blocks, self.start.problem.variables.values()
        blocks = (getattr(block, "weight", None) for block in blocks)
        return any(w is not None for w in blocks) or any(u.weight < 1 for u in unknowns)

    def linear(self, gradients: Gradients | None = None) -> Linearisation:
        problem, given = self.start.problem, self.start.associations
        layout = Layout.of(problem, kept=self.held)
        return linearise(problem, self.dense.values, given, layout, gradients)

    def estimate(self, linear: Linearisation) -> Estimate:
        """As a fit would leave it."""
        blocks = [*linear.layout.others, *KeptRows.of(linear)]
        blocks += [self.prior] if self.prior else []
        unknowns = list(linear.layout.outer().values())
        graph = Graph(unknowns, blocks, frozenset(self.held))
        return replace(self.start, values=self.dense.values, graph=graph, linear=linear)


def sources(name: str, folder: Path) -> list[Source]:
    """The recordings of a case, in a folder."""
    if name in SIMULATED:
        return [simulated.made(folder / "rec", SIMULATED[name])[0]]
    if name == "two recordings":
        return [Source.open(rigs.write(folder / str(k), seed=k)) for k in (1, 2)]
    box = rigs.write(folder / "box", seed=6, **BOXES.get(name, {}))
    if name == "a stop without scan":
        (box / "scans/s1.parquet").unlink()
    return [Source.open(box)]


def tied(problem: Problem) -> JointPrior:
    """Two frames and where one stop stood, known together from before."""
    held = [problem.variables[name] for name in ("mount", "root@a", "joints@s3")]
    spread = np.diag(np.concatenate([u.sigma for u in held]))
    mixed = spread @ np.random.default_rng(0).normal(size=(len(spread), 40))
    return JointPrior(held, {u.name: u.mean for u in held}, mixed @ mixed.T / 40)


def made(name: str, folder: Path) -> Case:
    """A case, shaken off where its fit would start."""
    problem = build(sources(name, folder), MODEL)
    start = preview(problem)
    prior = tied(problem) if name == "an earlier estimate" else None
    whole = start.problem
    sigma = {name: u.sigma for name, u in whole.variables.items()}
    rng = np.random.default_rng(1)
    steps = {n: np.minimum(s, 1e-3) * rng.uniform(-1, 1, len(s)) for n, s in sigma.items()}
    values = {
        n: rigs.retract(u.kind, start.values[n], steps[n]) for n, u in whole.variables.items()
    }
    blocks = (prior,) if prior else ()
    return Case(start, Dense(whole, values, start.associations, held=blocks), prior)
