"""Clouds and meshes as files, rays against a mesh, a mesh from a cloud. This is the open3d door."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from chains.errors import InputError
from chains.sizes import check_claim, check_stored
from sensors.documents import write_atomically
from sensors.ply import Columns, fans, read_ply, write_ply

_GROUPS = {
    "positions": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "colors": ("red", "green", "blue"),
}
"""The columns that Open3D holds as one array of three."""


def _open3d() -> ModuleType:
    """Open3D, opened late and without what it has for notebooks: its plots bring a web server
    along, which is half of the time that it takes to start, and its viewer prints that it is there.
    """
    plots, viewer = "open3d.visualization.draw_plotly", "OPEN3D_DISABLE_WEB_VISUALIZER"
    if "open3d" not in sys.modules and plots not in sys.modules:
        sys.modules[plots] = _LaterPlots(plots)
        os.environ.setdefault(viewer, "true")  # unless somebody has asked for it
        try:
            import open3d
        finally:
            del sys.modules[plots]
    import open3d

    return open3d


class _LaterPlots(ModuleType):
    """Stands for Open3D's plots until one is drawn."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def draw(*arguments: Any, **options: Any) -> Any:
            return getattr(importlib.import_module(self.__name__), name)(*arguments, **options)

        return draw


# ------------------------------------------------------------------------------------------ clouds


def read_cloud(path: str | Path) -> Columns:
    """Read a point cloud, PLY or PCD: every field by its name, each (N,) in its own type.

    Positions are x y z, normals nx ny nz, colours red green blue. Raises InputError for a file
    that is missing, empty, broken or no such cloud.
    """
    path = Path(path)
    if path.suffix.lower() == ".ply":
        columns = read_ply(path).get("vertex", {})
    elif path.suffix.lower() == ".pcd":
        columns = _read_pcd(path)
    else:
        raise InputError(f"{path}: a cloud is read from a .ply or .pcd file, not {path.suffix!r}")
    if not {"x", "y", "z"} <= columns.keys():
        fields = ", ".join(columns) or "none"
        raise InputError(f"{path} has no points: x, y and z are needed, its fields are {fields}")
    return {name: values for name, values in columns.items() if values.ndim == 1}


def write_cloud(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write a point cloud (binary PLY or PCD), whole or not at all; columns as `read_cloud`'s."""
    path = Path(path)
    if path.suffix.lower() == ".ply":
        write_ply(path, {"vertex": columns})
    elif path.suffix.lower() == ".pcd":
        _write_pcd(path, columns)
    else:
        raise InputError(f"{path}: a cloud is written to a .ply or .pcd file, not {path.suffix!r}")


def _read_pcd(path: Path) -> Columns:
    count = _count_of_pcd(path)
    o3d = _open3d()

    with _quiet():
        try:
            cloud = o3d.t.io.read_point_cloud(str(path), format="pcd")
            fields = list(cloud.point.items())
        except RuntimeError as error:
            raise InputError(f"{path} is a broken PCD file: {_sentence(error)}") from None
        except UnicodeDecodeError:
            raise InputError(f"{path} is a broken PCD file: a field has no name") from None
    columns: Columns = {}
    for name, tensor in fields:
        values = tensor.numpy()
        names = _GROUPS.get(name, (name,))
        columns |= {n: np.ascontiguousarray(values[:, i]) for i, n in enumerate(names)}
    columns.pop("_", None)  # what fills the gaps of a record
    if len(columns.get("x", ())) != count:
        raise InputError(
            f"{path} should hold {count} points, but they cannot be read; get the whole file"
        )
    return columns


def _count_of_pcd(path: Path) -> int:
    """How many points the header says there are: Open3D reads a broken file as an empty one."""
    try:
        with open(path, "rb") as file:
            head = file.read(1 << 14)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if not head:
        raise InputError(f"{path} is empty (0 bytes); a PCD file was wanted")
    count = re.search(rb"^POINTS\s+(\d+)", head, re.MULTILINE)
    data = re.search(rb"^DATA\s+(\w+)[^\n]*\n?", head, re.MULTILINE)
    if count is None or data is None:
        raise InputError(f"{path} is no PCD file: it has no header with POINTS and DATA")
    _check_pcd(path, head[: data.start()], data[1], data.end())
    return int(count[1])


def _check_pcd(path: Path, head: bytes, kind: bytes, start: int) -> None:
    """Refuse a header whose points the file cannot hold: Open3D believes it."""
    told = {line.split()[0]: line.split()[1:] for line in head.splitlines() if line.split()}
    try:
        points = int(told[b"POINTS"][0])
        wide = [int(size) for size in told.get(b"SIZE", ())]
        each = [int(count) for count in told.get(b"COUNT", ())] or [1] * len(wide)
        sound = {*wide} <= {1, 2, 4, 8} and min(each, default=0) >= 0
        if not sound or len(told.get(b"FIELDS", ())) != len(wide):
            raise ValueError
        record = sum(size * count for size, count in zip(wide, each, strict=True))
    except (KeyError, IndexError, ValueError):
        raise InputError(f"{path} is no PCD file: its header's lines do not agree") from None
    what = f"{points} points"
    if kind == b"binary":
        check_stored(path, start + points * record, what)
    elif kind == b"binary_compressed":
        with open(path, "rb") as file:
            file.seek(start)
            sizes = np.frombuffer(file.read(8), "<u4").astype(int)
        if len(sizes) < 2 or sizes[1] != points * record:
            raise InputError(f"{path} claims to hold {what}, which is not what is packed in it")
        check_stored(path, start + 8 + int(sizes[0]), what)
        check_claim(path, points * record, what)
    else:  # as text each number takes a digit and a space
        check_stored(path, start + 2 * points * sum(each) - 1, what)


def _write_pcd(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    o3d = _open3d()

    cloud = open3d_cloud(columns)
    with write_atomically(path) as temporary, _quiet():
        try:
            done = o3d.t.io.write_point_cloud(str(temporary), cloud)
        except RuntimeError as error:
            raise InputError(f"{path} cannot be written: {_sentence(error)}") from None
        if not done:
            raise InputError(f"{path} cannot be written as PCD")


def open3d_cloud(columns: Mapping[str, np.ndarray]) -> Any:
    """The columns (N,) as an `open3d.t.geometry.PointCloud`, every field an attribute (N, 1)."""
    o3d = _open3d()

    cloud, left = o3d.t.geometry.PointCloud(), dict(columns)
    # Open3D writes beyond its memory where normals are of another type than positions.
    number = np.result_type(np.float32, *(left[axis].dtype for axis in "xyz"))
    for group, names in _GROUPS.items():
        bytewise = group != "colors" or all(left[n].dtype == np.uint8 for n in names if n in left)
        if left.keys() >= set(names) and bytewise:
            values = np.stack([left.pop(name) for name in names], axis=1)
            values = values if group == "colors" else values.astype(number)
            cloud.point[group] = o3d.core.Tensor(values)
    for name, values in left.items():
        values = values.astype(np.uint8) if values.dtype == bool else values
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values).reshape(-1, 1))
    return cloud


def ransac_plane(points_m: np.ndarray, within_m: float) -> np.ndarray:
    """Rows (M,) of the points (N, 3) that lie no further than `within_m` from the plane that most
    do: RANSAC of Open3D, then least squares until the same points stay, whatever was drawn."""
    o3d = _open3d()

    if len(points_m) < 3:
        raise InputError(f"{len(points_m)} points lie on no plane in particular; 3 are needed")
    o3d.utility.random.seed(0)  # its threads still draw in any order
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    inliers = np.sort(cloud.segment_plane(within_m, ransac_n=3, num_iterations=1000)[1])
    for _ in range(20):
        away_m = points_m - points_m[inliers].mean(axis=0)
        normal = np.linalg.eigh(away_m[inliers].T @ away_m[inliers])[1][:, 0]
        again = np.flatnonzero(np.abs(away_m @ normal) <= within_m)
        if np.array_equal(again, inliers):
            break
        inliers = again
    return inliers


# ------------------------------------------------------------------------------------------ meshes


def read_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (V, 3) in double precision and triangles (F, 3) of a PLY, OBJ or STL file.

    Raises InputError for a file that is missing or broken, or has no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh; give a PLY, OBJ or STL file.")
    if path.suffix.lower() == ".ply":
        return _ply_triangles(path)
    if path.suffix.lower() not in (".obj", ".stl"):
        raise InputError(f"{path}: no triangles in it, or broken; give a PLY, OBJ or STL mesh.")
    o3d = _open3d()

    # The tensor reader would round doubles to float32; this one keeps them.
    with _quiet():
        mesh = o3d.io.read_triangle_mesh(str(path))
    if not mesh.has_triangles():
        raise InputError(f"{path}: no triangles in it, or broken; give a PLY, OBJ or STL mesh.")
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _ply_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a PLY file; polygons are cut into fans."""
    try:
        elements = read_ply(path)
    except InputError as error:
        why = str(error).removeprefix(str(path)).strip()
        raise InputError(
            f"{path}: no triangles in it, or broken ({why}); give a PLY, OBJ or STL mesh."
        ) from None
    vertex, face = elements.get("vertex", {}), elements.get("face", {})
    corners = face.get("vertex_indices", face.get("vertex_index", np.zeros((0, 3), int)))
    triangles, _ = fans(corners)
    if not {"x", "y", "z"} <= vertex.keys() or not len(triangles):
        raise InputError(f"{path}: no triangles in it, or broken; give a PLY, OBJ or STL mesh.")
    if triangles.min() < 0 or triangles.max() >= len(vertex["x"]):
        last = len(vertex["x"]) - 1
        raise InputError(f"{path}: a triangle has a vertex that is none of 0 to {last}")
    xyz = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(float)
    return xyz, triangles.astype(np.int32)


def ray_caster(vertices_m: np.ndarray, triangles: np.ndarray) -> Any:
    """A scene (Embree) that casts rays against vertices (V, 3) and triangles (F, 3), in float32."""
    o3d = _open3d()

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices_m.astype(np.float32), triangles.astype(np.uint32))
    return scene


def surface_normals(points_m: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of points (N, 3), of whichever sign: of the plane through 30 of them."""
    o3d = _open3d()

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    return np.array(cloud.normals)


def poisson_mesh(
    points_m: np.ndarray, normals: np.ndarray, depth: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A closed surface through oriented points (N, 3), as Poisson's equation has it.

    Its finest cells are 1 / 2^depth of 1.1 times the widest extent.

    Returns:
        Vertices (V, 3), triangles (F, 3), and how dense the points are round each vertex (V,): one
        more where they are half as far apart.
    """
    o3d = _open3d()

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    with _quiet():
        mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth
        )
    return np.array(mesh.vertices), np.array(mesh.triangles, np.int64), np.array(density)


def distance_to_mesh(
    vertices_m: np.ndarray, triangles: np.ndarray, points_m: np.ndarray
) -> np.ndarray:
    """Distance (N,) of points (N, 3) to the nearest triangle, m, in float32."""
    scene = ray_caster(vertices_m, triangles)
    return scene.compute_distance(points_m.astype(np.float32)).numpy().astype(np.float64)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what libraries print of a broken file off the terminal: the error raised says it."""
    o3d = _open3d()

    nowhere, kept = os.open(os.devnull, os.O_WRONLY), (os.dup(1), os.dup(2))
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            yield
    finally:
        for number, copy in enumerate(kept, start=1):
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)


def _sentence(error: RuntimeError) -> str:
    """What Open3D says, without its colours and where in its code."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).strip()
    return re.sub(r"^\[Open3D Error\] \(.*?\) \S+:\d+: ", "", text).rstrip(".")
