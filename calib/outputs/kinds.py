"""What a folder is, told by what lies in it, and where a command may therefore write."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from calib.outputs.workshop import settle
from chains import remote
from chains.errors import InputError

CLOUDS_MARK = ".rigcal-clouds"
_HEAD = 1 << 16  # bytes of a file among which an export says that it is one
# What they say; a picture of the frames by its title, and Hesai's table of angles by its columns.
_EXPORTED = (b"rigcal", b"<title>Frames of ", b"Channel,Elevation,Azimuth\n")


@dataclass(frozen=True)
class FolderKind:
    """A kind of folder that rigcal makes.

    Args:
        name: as people call it.
        lacks: what a folder lacks to be of this kind, as a clause; "" where it lacks nothing.
        parts: patterns of the names of what it is made of. These go when a folder is replaced by
            another of its kind; whatever else somebody has put there stays.
    """

    name: str
    lacks: Callable[[Path], str]
    parts: tuple[str, ...] = ()

    def holds(self, name: str) -> bool:
        """Whether a name is that of a part."""
        return any(Path(name).match(part) for part in self.parts)


def _without(*names: str) -> Callable[[Path], str]:
    """Says which of these files, all of which a kind has, is missing."""

    def lacks(folder: Path) -> str:
        return next((f"it has no {name}" for name in names if not (folder / name).is_file()), "")

    return lacks


def _lacks_simulated(folder: Path) -> str:
    truth = folder.with_name(f"{folder.name}.truth.json")
    why = RECORDING.lacks(folder)
    return why or ("" if truth.is_file() else f"there is no {truth.name} beside it")


def _lacks_run(folder: Path) -> str:
    others = ("solution.yaml", "covariance.npz", "state.npz")  # an incomplete run is one as well
    if not (folder / "model.yaml").is_file():
        return "it has no model.yaml"
    found = any((folder / name).is_file() for name in others)
    return "" if found else "it has no solution.yaml"


def _lacks_evaluation(folder: Path) -> str:
    return _without("evaluation.json", "points.parquet/_columns.yaml")(folder) or _is_other(folder)


def _lacks_plan(folder: Path) -> str:
    table = "targets.csv" if (folder / "targets.csv").is_file() else "stops.csv"
    return _without("plan.json", table)(folder) or _is_other(folder)


def _lacks_export(folder: Path) -> str:
    if other := _is_other(folder):
        return other
    told = any(map(is_exported, visible(folder)))
    return "" if told else "none of its files says that rigcal exported it"


def _lacks_ladder(folder: Path) -> str:
    others = [path for path in visible(folder) if not _is_rung(path)]
    others = [path.name for path in others if not _is_of_ladder(path)]
    return f"it holds {others[0]}" if others else ""


def _is_of_ladder(path: Path) -> bool:
    """Whether it is what stands beside the rungs: the explanation, and formulas that it keeps."""
    if path.name == "effects" and path.is_dir():
        return all(each.suffix == ".yaml" and is_exported(each) for each in visible(path))
    return path.name == "explanation.json"


def _is_rung(path: Path) -> bool:
    """Whether it is named as a rung, and nothing else than a run would be lost with it."""
    if not (path.is_dir() and path.name.isdigit() and len(path.name) == 2):
        return False
    return not RUN.lacks(path) or not any(path.iterdir())


def _is_other(folder: Path) -> str:
    """A recording or a run stays one, whatever else was written into it."""
    return next((f"it is a {each.name}" for each in (RECORDING, RUN) if not each.lacks(folder)), "")


def visible(folder: Path) -> list[Path]:
    """What lies in a folder, in order of name, but for what is hidden."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def is_exported(path: Path) -> bool:
    """Whether a file says at its head that an export wrote it."""
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    return any(words in head for words in _EXPORTED)


RECORDING = FolderKind(
    "recording",
    _without("rig.yaml", "stops.csv"),
    ("rig.yaml", "stops.csv", "targets.csv", "scans", "reference", "*.urdf"),
)
# A measured recording cost a week: no simulation takes its place.
SIMULATED = FolderKind("recording of a simulation", _lacks_simulated, RECORDING.parts)
RUN = FolderKind(
    "run",
    _lacks_run,
    (
        *("model.yaml", "solution.yaml", "summary.json", "covariance.npz", "state.npz"),
        *("residuals.parquet", "diagnosis.json", "evaluation.json", "points.parquet"),
    ),
)
EVALUATION = FolderKind("evaluation", _lacks_evaluation, ("evaluation.json", "points.parquet"))
EXPORT = FolderKind("export", _lacks_export)
CLOUDS = FolderKind("folder of corrected clouds", _without(CLOUDS_MARK))
PLANNED = FolderKind(
    "plan",
    _lacks_plan,
    ("stops.csv", "way.csv", "targets.csv", "plan.json", "before_after.svg"),
)
LADDER = FolderKind("ladder of runs", _lacks_ladder)


def refuse(
    path: Path | str,
    kind: FolderKind | None,
    inputs: Iterable[Path | str] = (),
    anywhere: bool = False,
) -> Path:
    """Where a path really is, links and ``..`` followed, if it may be written.

    Args:
        path: as the user gave it.
        kind: of the folder that is to be made; None of a file.
        inputs: files and folders that are read meanwhile.
        anywhere: whether it may lie inside a recording or a run, where an earlier version put it,
            as only what lies in it is written.

    Raises:
        InputError: it is an input, or inside one, or an input is inside it; or it lies inside a
            recording or run; or it is there, and neither empty nor of that kind; or it is
            write-protected.
    """
    if url := remote.url_of(remote.place(path)):
        raise InputError(f"{url}: an output is written to this machine's disk; give another -o")
    try:
        target = Path(path).resolve()
        for each in inputs:
            _refuse_input(path, target, Path(each))
        for above in () if anywhere else target.parents:
            if other := _is_other(above):
                name = other.removeprefix("it is a ")
                raise InputError(
                    f"{path} lies inside the {name} {above}; give an -o that is outside"
                )
        settle(target)  # or what a killed command left half-way would look like something else
        _refuse_other(path, target, kind)
        for each in (target,) if anywhere else (target, *target.rglob("*")):
            # Also of an immutable file, which even root could neither replace nor remove.
            if os.path.exists(each) and not each.is_symlink() and not os.access(each, os.W_OK):
                raise InputError(f"{each} is write-protected; lift that, or write elsewhere")
    except (OSError, RuntimeError) as error:  # the latter where links go round in a circle
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be written ({reason}); give another -o") from None
    return target


def _refuse_input(path: Path | str, target: Path, given: Path) -> None:
    if not given.exists():
        return
    if target.exists() and target.samefile(given):
        what = "folder" if given.is_dir() else "file"
        raise InputError(f"{path} exists and is read here; give another {what} with -o")
    if _inside(target, given):
        raise InputError(f"{path} lies inside {given}, which is read here; give an -o outside")
    if _inside(given.resolve(), target):
        raise InputError(
            f"{given}, which is read here, lies inside {path} and would be written over; give "
            "another -o"
        )


def _inside(path: Path, folder: Path) -> bool:
    """Whether a path is below a folder: by the folders themselves, as one may have two names."""
    if not folder.is_dir():
        return False
    return any(above.exists() and above.samefile(folder) for above in path.parents)


def _refuse_other(path: Path | str, target: Path, kind: FolderKind | None) -> None:
    if not target.exists():
        return
    if kind is None:
        if not target.is_file():
            what = "a folder" if target.is_dir() else "no ordinary file"
            raise InputError(f"{path} is {what}, so it cannot be written; give a file with -o")
    elif not target.is_dir():
        raise InputError(f"{path} is a file; give a folder with -o")
    elif any(target.iterdir()) and (why := kind.lacks(target)):
        raise InputError(
            f"{path} exists and is no {kind.name} ({why}); give another folder, or remove that one"
        )
