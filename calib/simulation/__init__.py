"""A recording of hardware that never was: the forward model run backwards, and its truth."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib import outputs
from calib.effects import trusted
from calib.rig import Rig, load_rig
from calib.simulation import rig as rig_on_paper
from calib.simulation.room import Room, build
from calib.simulation.scan import Scanner
from calib.simulation.spec import PRESETS, Spec, load_spec
from calib.simulation.stops import World, loads, plan
from calib.simulation.truth import Truth, draw, stream
from calib.simulation.write import write_reference, write_stops, write_targets, write_truth
from chains.errors import InputError
from sensors.documents import write_yaml
from sensors.recording import write_table

__all__ = ["PRESETS", "Spec", "load_spec", "simulate"]

Progress = Callable[[str, int, int], None]


def simulate(
    spec: str | Spec,
    out: Path | str,
    seed: int = 0,
    hide: Mapping[str, float] | None = None,
    progress: Progress | None = None,
    trust: Iterable[str | Path] = (),
) -> None:
    """Write a simulated recording, and the truth beside it as ``<out>.truth.json``.

    The hardware is drawn from the priors of its rig.yaml; every effect acts through its own basis,
    so whatever the catalogue holds can be hidden. The same spec and seed give the same files.

    Args:
        spec: a preset, the path of a YAML file, or a spec.
        out: the recording's folder; another simulated one there is replaced.
        seed: 0 or more.
        hide: effect, or file of effects -> size, in sigmas of its parameters (see `truth.draw`).
        progress: called with what is done, how much of it, and how much there is.
        trust: Python files of effects that a spec's file may name, or their sha256.

    Raises:
        InputError: the spec, the seed or an effect's name is wrong, or `out` is something else.
    """
    may_run = trusted(trust) if isinstance(spec, str) else None
    inputs, named = ([spec], spec) if isinstance(spec, str) else ([], "the specification")
    spec = load_spec(spec) if isinstance(spec, str) else spec
    if seed < 0:
        raise InputError(f"seed {seed} is negative; give 0 or more")
    with outputs.folder(out, outputs.SIMULATED, inputs, beside=("truth.json",)) as folder:
        rig, room = _on_paper(spec, folder, seed, named)
        truth = draw(rig, spec, dict(hide or {}), seed, may_run)
        _record(truth, spec, room, folder, seed, progress or (lambda what, done, total: None))


def _on_paper(spec: Spec, folder: Path, seed: int, named: str) -> tuple[Rig, Room]:
    """Write what is known before anything is measured; the specification's name is for messages."""
    room = build(spec.room, spec.mesh_error_m, stream(_world(spec, seed), "room"))
    if spec.mesh:
        write_reference(folder / "reference", room.measured)
    if spec.arm:
        (folder / "arm.urdf").write_text(rig_on_paper.urdf(), encoding="utf-8")
    write_yaml(path := folder / "rig.yaml", rig_on_paper.document(spec))
    try:
        return load_rig(folder), room
    except InputError as error:
        said = re.sub(rf"{re.escape(str(path))}(:\d+)?: ", "", str(error))
        raise InputError(f"{named}: {said}") from None


def _world(spec: Spec, seed: int) -> int:
    return seed if spec.world_seed is None else spec.world_seed


def _record(
    truth: Truth, spec: Spec, room: Room, folder: Path, seed: int, progress: Progress
) -> None:
    rig = truth.rig
    stops = plan(rig, spec, room.true, stream(seed, "plan"))
    more = loads(stops, truth, stream(seed, "loads"))
    stops = replace(stops, columns={**stops.columns, **more})
    world = World.of(truth, stops, spec.noise, stream(seed, "encoders"))
    write_stops(folder / "stops.csv", world, spec, stream(seed, "tracker"))
    if spec.targets:
        write_targets(folder / "targets.csv", truth, spec, stream(_world(spec, seed), "targets"))
    if spec.lidar:
        scanner, Ts_faro_lidar = Scanner(truth, room, spec), world.in_faro(rig.lidar_frame)
        if any("intensity" in effect.covariates for effect, _ in truth.effects):
            each = zip(Ts_faro_lidar, stops.names, strict=True)
            every = [scanner.intensities(T, stream(seed, f"scan {name}")) for T, name in each]
            scanner = replace(scanner, median_intensity=float(np.median(np.concatenate(every))))
        for k, name in enumerate(stops.names):
            columns = {c: v[k : k + 1] for c, v in world.columns.items()}
            rng = stream(seed, f"scan {name}")
            scan = scanner.scan(Ts_faro_lidar[k], columns, stops.joints[k : k + 1], rng)
            write_table(folder / "scans" / f"{name}.parquet", scan)
            progress("simulating", k, len(stops.names))
    write_truth(folder / "truth.json", world, spec, seed)
