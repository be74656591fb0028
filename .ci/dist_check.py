"""Installs the wheel and the sdist outside the checkout, and runs the quick tests against each.

    .venv/bin/python .ci/dist_check.py dist

Each is installed alone into an environment of its own, which borrows all other packages from the
one that runs this; so no network is needed, and nothing of the checkout can be imported.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("chains", "sensors", "calib")
# Of each package some, chosen to be quick; none needs a browser or a fit.
TESTS = (
    *("tests/chains", "tests/sensors/test_recording.py", "tests/sensors/test_documents.py"),
    *("tests/sensors/test_lidar.py", "tests/calib/test_rig.py", "tests/calib/test_effects.py"),
    "tests/test_packaging.py",
)
LOOP = (
    *("simulate tiny -o rec --seed 1", "check rec", "fit rec -o run --hold-out none"),
    *("report run -o report.html", "export run -o out", "effects", "--version"),
)


def run(*command: object, folder: Path) -> str:
    """What a program prints; it ends this one where it fails."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    words = list(map(str, command))
    done = subprocess.run(words, cwd=folder, env=clean, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}\n{done.stdout[-4000:]}{done.stderr[-4000:]}")
    return done.stdout


def environment(folder: Path) -> Path:
    """An environment that sees this one's packages, after its own; its Python."""
    venv.create(folder, with_pip=True, symlinks=True)
    python = folder / "bin" / "python"
    # Python 3.11 brings a setuptools that is too old to build us, in front of the borrowed one.
    run(python, "-m", "pip", "uninstall", "--quiet", "--yes", "setuptools", folder=folder)
    own = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=folder)
    # A folder that a .pth file names is not asked for .pth files: our editable install is not seen.
    places = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    inner = [
        p for place in places for p in Path(place).glob("cmeel.prefix/lib/python*/site-packages")
    ]
    (Path(own.strip()) / "borrowed.pth").write_text("\n".join(map(str, (*places, *inner))) + "\n")
    return python


def check(package: Path, tests: Path, folder: Path) -> None:
    """Install one file and try it from a folder in which nothing else of rigcal lies."""
    python = environment(folder / "env")
    pip = (python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation")
    run(*pip, "--disable-pip-version-check", "--no-index", package, folder=folder)
    outside = folder / "outside"
    for name in ("tests", "pyproject.toml", "requirements.lock", "docs"):
        source = tests / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, _made(outside) / name)
    where = run(python, "-c", "import calib; print(calib.__file__)", folder=outside)
    if not where.startswith(str(folder / "env")):
        raise SystemExit(f"{package.name}: imported from {where}")
    for line in LOOP:
        run(python.parent / "rigcal", *line.split(), folder=folder)
    options = ("-q", "-m", "not slow and not long", "-p", "no:cacheprovider")
    told = run(python, "-m", "pytest", *options, *TESTS, folder=outside)
    print(f"{package.name}: {told.strip().splitlines()[-1]}")


def _made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder


def files(folder: Path) -> set[str]:
    """The packages' files, below a folder."""
    found = (path for package in PACKAGES for path in (folder / package).rglob("*"))
    kept = (path for path in found if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in kept}


def main() -> None:
    """Check both."""
    dist = Path(sys.argv[1]).resolve()
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        source = folder / sdist.name.removesuffix(".tar.gz")
        in_wheel = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
        for where, there in (("checkout", files(ROOT)), ("sdist", files(source))):
            if other := there ^ in_wheel:
                raise SystemExit(f"wheel and {where} differ: {', '.join(sorted(other))}")
        for package in (wheel, sdist):
            check(package, source, _made(folder / package.suffix.strip(".")))


if __name__ == "__main__":
    main()
