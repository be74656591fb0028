"""What a corrected pose costs, and a command, against the graph's own kinematics.

    python tests/bench/bench_arm.py RUN [--poses 100000]

A run of an arm, at joints drawn over their limits. The other side is `calib.forward`, which gives
derivatives by every unknown as well. Both run in one process on one thread; times are CPU seconds.
The two must agree to 1e-9.
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np
from workload import threads

from calib import Arm, Run
from calib.evaluation import values_of
from calib.forward import place
from calib.results.reach import joint_range
from calib.runs.reopen import problem_of, reopened, state_of

FEW = 2000  # poses for the graph's kinematics: chunks of any size take as long by pose


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("run")
    options.add_argument("--poses", type=int, default=100_000)
    asked = options.parse_args()
    threads(1)
    run = Run.open(asked.run)
    (source,) = reopened(run)
    problem, arm = problem_of(run, [source]), Arm.of(run)
    values, seen = values_of(problem, state_of(run, problem)), source.recording.joints
    joints = np.random.default_rng(0).uniform(
        *joint_range(source.rig, seen), (asked.poses, seen.shape[1])
    )

    def rate(what, some: np.ndarray) -> tuple[float, object]:
        began = process_time()
        found = what(some)
        return len(some) / (process_time() - began), found

    def graph(some: np.ndarray) -> np.ndarray:
        stops = place(source.rig, problem.terms[0], some, {}, "root", None)
        T_base, T_tip = (stops.in_root(frame, values).T for frame in (arm.base, arm.tip))
        return np.linalg.inv(T_base) @ T_tip

    for what in (arm.corrected, arm.to_command, graph):
        what(joints[:FEW])  # warm
    ours, T = rate(arm.corrected, joints)
    theirs, T_graph = rate(graph, joints[:FEW])
    inverse, command = rate(arm.to_command, joints)
    apart = np.abs(T[:FEW] - T_graph).max()
    reached = np.mean(command.off_m < 1e-7)
    print(f"corrected     {ours:10.0f} poses/s, {ours / theirs:.1f} times the graph's {theirs:.0f}")
    print(f"to_command    {inverse:10.0f} poses/s, {100 * reached:.1f} % reached to 0.1 um")
    print(f"largest difference from the graph {apart:.1e}")
    assert apart < 1e-9


if __name__ == "__main__":
    main()
