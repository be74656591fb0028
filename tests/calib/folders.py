"""Small folders of each kind, for tests of how they are written."""

import shutil
from pathlib import Path


def recording(folder: Path, **files: str) -> Path:
    folder.mkdir(parents=True)
    for name, text in {"rig.yaml": "name: a", "stops.csv": "stop", **files}.items():
        (folder / name).write_text(text)
    return folder


def run(folder: Path, text: str = "old") -> Path:
    (folder / "residuals.parquet").mkdir(parents=True)
    for name in ("model.yaml", "solution.yaml", "residuals.parquet/a.parquet"):
        (folder / name).write_text(text)
    return folder


def fill(folder: Path, text: str = "new") -> None:
    shutil.copytree(run(folder / "made", text), folder, dirs_exist_ok=True)
    shutil.rmtree(folder / "made")


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}
