"""A recording's folder as what can be spoilt: its tables, its scans, what meets at a stop.

Reading and writing is all that is shared with the program; geometry is scipy's.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table

XYZ, QUAT = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
PARTS = ("sphere", "lower", "upper", "rod")

# What is taken for just detectable where no diagnosis says it: about four sigmas of the instruments
# of the recordings here (tracker 0.2 mm and 0.3 mrad, spheres 0.6 mm), of CAD and of lengths.
USUAL = {
    "body m": 0.0010,
    "body rad": 0.0015,
    "joint rad": 0.0010,
    "scan m": 0.0020,
    "scan rad": 0.0015,
    "target m": 0.0030,
    "frame m": 0.0060,
    "frame rad": 0.0120,
    "length m": 0.0200,
    "surface m": 0.0050,
}


class Sheet:
    """A CSV file: columns by name, one text per row."""

    def __init__(self, path: Path) -> None:
        with path.open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        self.columns = {name: [row[i] for row in rows] for i, name in enumerate(head)}

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def numbers(self, *names: str) -> np.ndarray:
        """(K, names); what is empty is NaN."""
        return np.array([[float(x or "nan") for x in self.columns[n]] for n in names]).T

    def put(self, values: np.ndarray, *names: str) -> None:
        """Write (K, names) numbers; NaN is empty."""
        for name, column in zip(names, np.atleast_2d(values.T), strict=True):
            self.columns[name] = ["" if np.isnan(x) else repr(float(x)) for x in column]

    def keep(self, rows: list[int]) -> None:
        """These rows, in this order; one may be there twice."""
        self.columns = {name: [c[i] for i in rows] for name, c in self.columns.items()}

    def write(self, path: Path) -> None:
        """Write the file."""
        with path.open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file, lineterminator="\n")
            out.writerow(self.columns)
            out.writerows(zip(*self.columns.values(), strict=True))


@dataclass
class Scene:
    """A recording that is being spoilt.

    Args:
        folder: the recording.
        rng: for which stop, which body, which way.
        detectable: ``TOKEN UNIT`` -> the smallest size that can be detected, where it is known.
    """

    folder: Path
    rng: np.random.Generator
    detectable: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def rig(self) -> dict[str, Any]:
        """rig.yaml."""
        return read_yaml(self.folder / "rig.yaml")[0]

    @cached_property
    def stops(self) -> Sheet:
        """stops.csv as it is now."""
        return Sheet(self.folder / "stops.csv")

    @property
    def names(self) -> list[str]:
        """Of the stops."""
        return self.stops.columns["stop"]

    @cached_property
    def urdf(self) -> str:
        """The URDF's name; empty without an arm."""
        return self.rig.get("arm", {}).get("urdf", "")

    @cached_property
    def joints(self) -> list[str]:
        """Moving joints."""
        if not self.urdf:
            return []
        text = (self.folder / self.urdf).read_text(encoding="utf-8")
        found = re.findall(r'<joint\s+name="([^"]+)"\s+type="(\w+)"', text)
        return [name for name, kind in found if kind != "fixed"]

    @property
    def bodies(self) -> list[str]:
        """Tracked, that of the base first."""
        return (self.rig.get("tracker") or {}).get("bodies", [])

    @property
    def has_mesh(self) -> bool:
        """Whether ranges are held against a surface."""
        return "mesh" in (self.rig.get("reference") or {})

    @property
    def poses(self) -> bool:
        """Whether bodies are seen turned as well as placed."""
        return bool(self.bodies) and f"{self.bodies[0]}.qw" in self.stops.columns

    def features(self) -> set[str]:
        """What there is, as a mishap's needs are named."""
        there = {
            "arm": bool(self.joints),
            "tracker": bool(self.bodies),
            "poses": self.poses,
            "base": len(self.bodies) > 1,
            "mesh": self.has_mesh,
            "lidar": "lidar" in self.rig and (self.folder / "scans").is_dir(),
            "targets": (self.folder / "targets.csv").is_file(),
        }
        return {name for name, found in there.items() if found}

    # ------------------------------------------------------------------------------- what meets

    def seen(self, body: str) -> np.ndarray:
        """(K,) stops at which a body was seen."""
        return np.isfinite(self.stops.numbers(f"{body}.x")[:, 0])

    def scan_path(self, stop: str) -> Path:
        """Of a stop's scan."""
        return self.folder / "scans" / f"{stop}.parquet"

    def paths(self, stop: str) -> list[set[str]]:
        """Ways from the room to the sensor's mount at a stop: what each leans on.

        What stands on one way cannot be told apart by this stop alone, and where there are but two
        ways, neither can these.
        """
        k = self.names.index(stop)
        seen = [body for body in self.bodies if self.seen(body)[k]]
        base = {f"{stop}:{body}" for body in seen[:1] if len(self.bodies) > 1}
        if self.joints and (base or self.rig["base"]["moves"] != "stop"):
            base |= {f"{stop}:joints"}
        hands = seen[1:] if len(self.bodies) > 1 else seen
        ways = [base, *({f"{stop}:{body}"} for body in hands)]
        if self.scan_path(stop).is_file():
            ways.append({f"{stop}:scan"})
        return [way for way in ways if way]

    def group(self, token: str) -> set[str]:
        """Names that this stop's data cannot tell from one of them."""
        ways = self.paths(token.partition(":")[0])
        if len(ways) < 3:
            return set().union(*ways)
        return next((way for way in ways if token in way), set())

    def stop(self, *bodies: str) -> str:
        """One of the stops at which bodies were seen, and there is most to tell who is wrong."""
        good = np.all([self.seen(body) for body in bodies], axis=0) if bodies else None
        names = [n for k, n in enumerate(self.names) if good is None or good[k]]
        most = max(len(self.paths(n)) for n in names)
        return str(self.rng.choice([n for n in names if len(self.paths(n)) == most]))

    def some(self, times: float) -> list[str]:
        """As many stops, drawn; fewer than a half."""
        most = max(1, (len(self.names) - 1) // 2)
        return [str(n) for n in self.rng.choice(self.names, min(int(times), most), replace=False)]

    def size(self, token: str, kind: str) -> float:
        """The smallest size of a blunder of this name that can be detected."""
        return self.detectable.get(f"{token} {kind.split()[1]}", USUAL[kind])

    def way(self) -> np.ndarray:
        """(3,) a direction."""
        v = self.rng.standard_normal(3)
        return v / np.linalg.norm(v)

    # ------------------------------------------------------------------------------ what changes

    @contextmanager
    def sheet(self, name: str) -> Iterator[Sheet]:
        """A CSV file that is written again; what stops.csv said stays what is asked."""
        sheet = Sheet(self.folder / name)
        yield sheet
        sheet.write(self.folder / name)

    @contextmanager
    def description(self) -> Iterator[dict[str, Any]]:
        """rig.yaml, written again."""
        path = self.folder / "rig.yaml"
        data, _ = read_yaml(path)
        yield data
        write_yaml(path, data)

    def move(self, body: str, rows: list[int], shift_m: np.ndarray, turn: np.ndarray) -> None:
        """Say that a body was elsewhere: shift (3,) in the tracker's axes, rotation vector (3,)
        about its own."""
        with self.sheet("stops.csv") as stops:
            at, quat = ([f"{body}.{p}" for p in parts] for parts in (XYZ, QUAT))
            xyz = stops.numbers(*at)
            xyz[rows] += shift_m
            stops.put(xyz, *at)
            if np.any(turn):
                q = stops.numbers(*quat)
                R = Rotation.from_quat(q[rows], scalar_first=True) * Rotation.from_rotvec(turn)
                q[rows] = R.as_quat(scalar_first=True)
                stops.put(q, *quat)

    def each_scan(self, change: Callable[[dict[str, np.ndarray]], object], *stops: str) -> None:
        """Change the columns of scans, of all stops if none is named; XYZ is kept in float32."""
        paths = map(self.scan_path, stops or self.names)
        for path in (p for p in paths if p.is_file()):
            columns = read_table(path)
            kinds = {name: column.dtype for name, column in columns.items()}
            columns = change(columns) or columns
            write_table(path, {n: c.astype(kinds.get(n, c.dtype)) for n, c in columns.items()})

    def vertices(self) -> tuple[bytes, np.ndarray, np.ndarray, bytes]:
        """Of the binary mesh: its head, vertices (V, 3), triangles (F, 3), its tail."""
        raw = (self.folder / "reference/mesh.ply").read_bytes()
        start = raw.index(b"end_header\n") + len(b"end_header\n")
        count, faces = (
            int(re.search(rb"element %s (\d+)" % what, raw)[1]) for what in (b"vertex", b"face")
        )
        at = np.frombuffer(raw, "<f8", 3 * count, start).reshape(-1, 3).copy()
        rows = np.frombuffer(raw, "u1", 13 * faces, start + at.nbytes).reshape(faces, 13)
        return raw[:start], at, rows[:, 1:].copy().view("<u4"), raw[start + at.nbytes :]

    def remesh(self, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        """Move the mesh's vertices by a function of them (V, 3) and of the triangles (F, 3)."""
        head, at, triangles, tail = self.vertices()
        moved = np.ascontiguousarray(change(at, triangles), "<f8").tobytes()
        (self.folder / "reference/mesh.ply").write_bytes(head + moved + tail)

    def rewrite(self, name: str, old: str, new: str) -> None:
        """Replace a text that stands once or more in a file, the first time."""
        path = self.folder / name
        text = path.read_text(encoding="utf-8")
        assert old in text, f"{name} has no {old}"
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
