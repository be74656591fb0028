"""The study that rigcal grew from, in one command: its tables and figures, its methods and ours.

Four LiDARs on one arm are simulated under the study's conditions. The study's own sequence (circles
for the arm's lengths, spheres for the scanner's frame, CAD for mount and LiDAR, averages for range
offsets) is set beside CAD alone, the joint graph, and the graph with what its diagnosis found. All
learn from the same stops, and are judged by the same others. OUT/study.md is the page.

    python examples/paper_study.py [OUT] [--quick]
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

# BLAS threads on shared cores cost many times what they save; set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from paper import FULL, QUICK, study


def main() -> None:
    """Run the study, and say how it came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, help="folder to write to")
    parser.add_argument(
        "--quick", action="store_true", help="two LiDARs, few stops: a minute or so"
    )
    asked = parser.parse_args()
    out = asked.out or Path(tempfile.mkdtemp(prefix="rigcal-"))
    results = study(out, QUICK if asked.quick else FULL, 1 if asked.quick else 2, tell)
    for claim in results["shape"]:
        print("yes" if claim["holds"] else "NO ", f"{claim['claim']}: {claim['figures']}")
    for sensor, row in results["sensors"].items():
        for method, line in row["methods"].items():
            print(f"{sensor:8} {method:40} held out {line['held_out_rms']:6.2f} mm")
    print(f"wrote {out / 'study.md'}")


def tell(what: str, done: int, total: int) -> None:
    """A line that is written over, on a terminal."""
    if sys.stderr.isatty():
        print(f"\r{what} {done + 1}/{total}\033[K", end="", file=sys.stderr)


if __name__ == "__main__":  # processes of its own read this file again
    main()
