"""A run for others to use. A new format is a function and a line in `FORMATS`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from calib import outputs
from calib.exporters.dh import write_dh
from calib.exporters.fitted import Fitted, Format
from calib.exporters.rings import write_hesai, write_ouster, write_rings
from calib.exporters.tables import write_latex, write_markdown
from calib.exporters.transforms import write_autoware, write_kalibr, write_ros2
from calib.exporters.tree import write_tree
from calib.exporters.urdf import write_urdf
from calib.exporters.written import Unheld
from calib.exporters.yaml_extrinsics import read_extrinsics, write_extrinsics
from calib.linear.parallel import one_blas_thread
from calib.runs.run import Run
from chains.errors import InputError

__all__ = ["FORMATS", "Exported", "export", "read_extrinsics"]

FORMATS: dict[str, Format] = {
    "yaml": write_extrinsics,
    "urdf": write_urdf,
    "dh": write_dh,
    "ros2": write_ros2,
    "autoware": write_autoware,
    "kalibr": write_kalibr,
    "rings": write_rings,
    "hesai": write_hesai,
    "ouster": write_ouster,
    "tree": write_tree,
    "latex": write_latex,
    "markdown": write_markdown,
}


@dataclass(frozen=True)
class Exported:
    """What an export wrote, and what it could not.

    Args:
        files: those written.
        not_held: format -> a sentence for each thing that its files have no place for.
        left_out: format -> why nothing of it was written.
    """

    files: list[Path] = field(default_factory=list)
    not_held: dict[str, list[str]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


@one_blas_thread
def export(run: Run, out: Path | str, formats: Sequence[str] = (), force: bool = False) -> Exported:
    """Write a run in the formats named, or in all that have anything to hold if none is.

    Args:
        run: what to write.
        out: the folder to write to; of an earlier export there, files of the same name are
            replaced and the others kept.
        formats: names in `FORMATS`.
        force: whether a run that has not converged is written; each file then says so.

    Raises:
        InputError: the run has not converged, an unknown format, one named that has nothing to
            hold, or `out` is a file.
    """
    run.refuse_unconverged(force)
    out, done = Path(out), Exported()
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"--format {name}: unknown format; there are {', '.join(FORMATS)}")
    with outputs.folder(out, outputs.EXPORT, [run.folder, *run.inputs]) as folder:
        fitted = Fitted(run)
        for name in dict.fromkeys(formats or FORMATS):
            try:
                written = FORMATS[name](fitted, folder)
            except Unheld as error:
                if formats:
                    raise InputError(f"--format {name}: {error}") from None
                done.left_out[name] = str(error)
                continue
            done.files.extend(out / file.name for file in written.files)
            done.not_held[name] = written.not_held
        for file in done.files:
            if file.exists() and not outputs.is_exported(file):
                raise InputError(f"{file} was not written by rigcal; move it, or give another -o")
    return done
