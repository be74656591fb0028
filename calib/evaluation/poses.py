"""What effects look at, at poses that were not measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from calib.effects import Effect, View
from calib.problem.model import Source
from calib.rig.columns import load_columns, recorded_columns, stop_columns
from chains.errors import InputError, NoColumnError

MEASURED_POSES = 20  # by which it is seen whether an effect feels a payload; a choice


def loads_felt(source: Source, effects: Iterable[Effect]) -> dict[str, str]:
    """Columns by which a recording says that the arm carries something, and an effect that bends
    the arm otherwise by it; of those that have one."""
    loads = load_columns(source.rig).values()
    stated = [n for n in loads if n in source.columns and np.nan_to_num(source.columns[n]).any()]
    found = ((n, next((e.name for e in effects if _feels(source, e, n)), None)) for n in stated)
    return {load: effect for load, effect in found if effect}


def pose_columns(
    source: Source,
    joints: np.ndarray,
    given: Mapping[str, np.ndarray],
    felt: Mapping[str, str],
    time_s: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Columns (K, ...) of poses that were not measured: those given, and what follows from them.

    Args:
        source: the recording that was fitted. Up is where levels had it on average there.
        joints: (K, J) reported, rad or m.
        given: column -> (K,) values, as in the recording.
        felt: loads that are to be given, as `loads_felt` has them.
        time_s: (K,) when the poses are; None where nothing says.

    Raises:
        InputError: a load that is to be given is not.
    """
    rig, count = source.rig, len(joints)
    times = np.full(count, np.nan) if time_s is None else time_s
    columns = {**stop_columns(rig, joints, times, given), **recorded_columns(given)}
    if "up" in source.columns and "up" not in columns:
        up = np.mean(source.columns["up"], axis=0)
        columns["up"] = np.broadcast_to(up / np.linalg.norm(up), (count, 3))
    for load, effect in felt.items():
        if load not in columns:
            raise InputError(
                f"effect '{effect}' feels what the arm carries, and the recording states {load}; "
                f"give {load} for these poses too, 0 where the arm carries nothing"
            )
    return columns


def moves(source: Source, effect: Effect, frame: str) -> bool:
    """Whether an effect of edges moves a frame, or another before it, at any pose measured."""
    joints, path = source.recording.joints, list(source.rig.tree.path(frame))
    try:
        basis = effect.basis(View(source.rig, len(joints), source.columns, joints))
    except NoColumnError:
        return True  # as far as anyone knows
    return bool(np.any(basis[:, path]))


def to_give(column: str) -> str:
    """The column of a table of poses from which one follows that effects look at."""
    if column == "torques":
        return "<joint>.torque of each joint"
    follows = column == "elapsed_s" or column.startswith(("travel.", "moved.", "waited."))
    return "time_s" if follows else column


def basis_at(effect: Effect, view: View) -> np.ndarray:
    """The basis of an effect at poses that were not measured.

    Raises:
        InputError: it looks at a column that was not given.
    """
    try:
        return effect.basis(view)
    except NoColumnError as error:
        raise InputError(
            f"effect '{effect.name}' looks at column '{error.column}', which was not given for "
            "these poses; give it, for each of them"
        ) from None


def _feels(source: Source, effect: Effect, load: str) -> bool:
    """Whether an effect bends the arm otherwise without a payload, at poses of the recording."""
    loaded = np.flatnonzero(np.nan_to_num(source.columns[load]))[:MEASURED_POSES]
    joints = source.recording.joints[loaded]
    columns = {n: np.asarray(c)[loaded] for n, c in source.columns.items()}
    try:
        with_load, without = (
            effect.basis(View(source.rig, len(joints), some, joints))
            for some in (columns, {**columns, load: np.zeros(len(joints))})
        )
    except NoColumnError:
        return False  # it asks for another column, and says so itself
    return not np.array_equal(with_load, without)
