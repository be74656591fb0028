"""Small whole files of every format, made by the libraries that own it, and real ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from sensors.lidar import CATALOG
from sensors.recording import write_table

from ..calib import rigs
from ..sensors.readers.arms import test_dh, test_urdf
from ..sensors.readers.bags.test_bag import FORMATS, START_NS, Bag, cloud_points
from ..sensors.readers.clouds.test_files import TABLE, WRITERS
from ..sensors.readers.packets import test_hesai, test_ouster
from ..sensors.readers.packets.captures import write_pcap, write_pcapng
from ..sensors.readers.poses import test_industrial_calibration, test_motive, test_vicon
from .outcomes import Sample

FORMULA = """\
name: damp
site: range
unit: "1"
sigma: 0.01
basis: ["(range - 2) * sin(azimuth)", "where(range > 3, 1, 0)"]
"""
NO_RINGS = {"lidar": "velodyne_vlp16", "rings_from_elevation": True}
SPEC = "{lidar: hesai_pandarxt32, locations: 2, acting: {range_scale: 0.001}}\n"


def made(folder: Path) -> list[Sample]:
    """Samples of every reader."""
    return [
        *_clouds(folder),
        *_bags(folder),
        *_packets(folder),
        *_texts(folder),
        *_meshes(folder),
        *_recording(folder),
    ]


def _clouds(folder: Path) -> list[Sample]:
    found = []
    for kind, (name, write) in WRITERS.items():
        path = folder / name.replace("a.", f"sample_{kind}.", 1)
        write(path)
        found.append(Sample(kind, path, NO_RINGS if kind == "kitti" else {}))
    np.savez_compressed(folder / "squeezed.npz", points=TABLE[:, :3], ring=TABLE[:, 4])
    np.savez(folder / "stored.npz", points=TABLE[:, :3], ring=TABLE[:, 4])
    columns = {axis: TABLE[:, k] for k, axis in enumerate("xyz")}
    write_table(folder / "points.parquet", columns | {"ring": TABLE[:, 4].astype(np.uint16)})
    _pcds(folder)
    return [
        *found,
        *(Sample("numpy", folder / name) for name in ("squeezed.npz", "stored.npz")),
        *(Sample("pcd", folder / name) for name in ("text.pcd", "packed.pcd")),
        Sample("cloud", folder / "sample_ply.ply"),
        Sample("table of points", folder / "points.parquet"),
        Sample("survey", folder / "sample_e57.e57"),
        Sample("survey", folder / "sample_ply.ply"),
    ]


def _pcds(folder: Path) -> None:
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(TABLE[:50, :3].astype(np.float32)))
    cloud.point["ring"] = o3d.core.Tensor(TABLE[:50, 4:].astype(np.uint16))
    o3d.t.io.write_point_cloud(str(folder / "text.pcd"), cloud, write_ascii=True)
    o3d.t.io.write_point_cloud(str(folder / "packed.pcd"), cloud, compressed=True)


def _bags(folder: Path) -> list[Sample]:
    found = []
    for storage in FORMATS:
        with Bag(folder / f"bag_{storage}", storage) as bag:
            for k in range(2):
                bag.cloud("/points", START_NS + k * 10**8, cloud_points()[:200])
                bag.joints(START_NS + k * 10**8, ["a", "b"], [0.01 * k, 1.0])
        path = bag.path
        if path.is_dir():
            found.append(Sample("bag", path / "metadata.yaml", beside=()))
            path = next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
        found.append(Sample("bag", path))
    return [s for s in found if s.path.suffix != ".yaml"]


def _packets(folder: Path) -> list[Sample]:
    turns = test_hesai.turns("PandarXT-16", 2, 40)
    sent = [(t, 2368, data) for t, data in turns]
    rows = [f"{k + 1},{e},0" for k, e in enumerate(test_hesai.elevation_deg("PandarXT-16"))]
    (folder / "angles.csv").write_text("\n".join(["Laser id,Elevation,Azimuth", *rows]))
    angles = {"metadata": str(folder / "angles.csv")}
    (folder / "ouster.json").write_text(json.dumps(test_ouster.facts()))
    return [
        Sample("angles", folder / "angles.csv"),
        Sample("sensor", folder / "ouster.json"),
        Sample("hesai", write_pcap(folder / "hesai.pcap", sent), angles),
        Sample("hesai", write_pcap(folder / "parts.pcap", sent, mtu=500), angles),
        Sample("hesai", write_pcapng(folder / "hesai.pcapng", sent), angles),
    ]


def _texts(folder: Path) -> list[Sample]:
    test_motive.take(folder / "motive.csv")
    turn = test_vicon.TURN.as_quat()
    files = {
        "vicon.csv": ("vicon", test_vicon.bodies(turn, "") + test_vicon.MARKERS),
        "arm.urdf": ("urdf", test_urdf.ARM),
        "arm.xacro": ("urdf", test_urdf.MACRO),
        "dh.yaml": ("dh", test_dh.WRITTEN["a.yaml"]),
        "dh.csv": ("dh", test_dh.WRITTEN["b.csv"]),
        "poses.tum": ("tum", "".join(f"{k} 0 0 {k} 0 0 0 1\n" for k in range(9))),
        "poses.csv": (
            "euroc",
            "#timestamp [ns], x, y, z, qw, qx, qy, qz\n"
            + "".join(f"{k}000000,0,0,{k},1,0,0,0\n" for k in range(9)),
        ),
        "log.csv": ("table", "time_s,q1,q2\n" + "".join(f"{k},0.{k},1\n" for k in range(9))),
        "spheres.csv": ("spheres", "name,x,y,z\na,0,0,0\nb,1,0,0\nc,0,1,0\n"),
        "plate.yaml": ("industrial_calibration", json.dumps(test_industrial_calibration.ROWS)),
        "effect.yaml": ("effects", FORMULA),
        "spec.yaml": ("spec", SPEC),
        "palette.yaml": ("palette", "0: floor\n1: [255, 0, 0]\n"),
        "palette.csv": ("palette", "label,name\n0,floor\n1,wall\n"),
        "scanner.yaml": ("lidar", (CATALOG / "velodyne_vlp16.yaml").read_text()),
    }
    found = [Sample("motive", folder / "motive.csv")]
    for name, (kind, text) in files.items():
        (folder / name).write_text(text)
        found.append(Sample(kind, folder / name, {"rows": "log"} if kind == "table" else {}))
    return found


def _meshes(folder: Path) -> list[Sample]:
    import trimesh

    box = trimesh.creation.box((8, 6, 3)).subdivide()
    kinds = ("ply", "obj", "stl", "glb", "off")
    for kind in kinds:
        box.export(folder / f"room.{kind}")
    box.export(folder / "text.ply", encoding="ascii")
    box.export(folder / "text.stl", file_type="stl_ascii")
    names = [*(f"room.{kind}" for kind in kinds), "text.ply", "text.stl"]
    return [
        *(Sample("mesh", folder / name) for name in names),
        *(Sample("surface", folder / f"room.{kind}") for kind in ("ply", "obj", "stl")),
        Sample("surface", folder / "text.stl"),
    ]


def _recording(folder: Path) -> list[Sample]:
    """The parts of a recording and of a run."""
    rec = rigs.write(folder / "rec", seed=4)
    run = calibrate([rec], folder / "run", Model(("ring_range_offset",)), "none").folder
    parts = sorted(p for p in rec.rglob("*") if p.is_file() and p.parent.name != "scans")
    parts.append(min((rec / "scans").iterdir()))
    files = ("model.yaml", "solution.yaml", "summary.json", "covariance.npz", "state.npz")
    found = [Sample("recording", part) for part in parts]
    return [*found, *(Sample("run", run / name) for name in files)]


def real(shared: Path, folder: Path) -> list[Sample]:
    """Copies of small real files, to be damaged."""
    ouster, hesai = shared / "lidar/ouster_sdk_tests", shared / "lidar/hesai_nebula"
    sensor = {"metadata": str(ouster / "OS-0-32-U1_v2.2.0_1024x10.json")}
    angles = {"metadata": str(hesai / "calibration/PandarQT64.csv")}
    arms = shared / "arms"
    given = [
        ("bag", ouster / "512x10_raw.bag", sensor),
        ("ouster", ouster / "OS-0-32-U1_v2.2.0_1024x10.pcap", sensor),
        ("ouster", ouster / "single_scan_016.osf", {}),
        ("ouster", ouster / "OS-0-128_v3.0.1_1024x10_20241017_141645.osf", {}),
        ("bag", hesai / "qt64/1673401195788312575_0.db3", angles),
        ("pcd", hesai / "xt32m/1660893203292679064.pcd", {"rings_from_elevation": True}),
        ("e57", shared / "reference/e57_pump/pumpAVisualReferenceImage.e57", {}),
        ("motive", shared / "tracking/motive_csv_sample/sample_optitrack_take.csv", {}),
        ("table", arms / "ur10_tmac/Series_D/calibration_handeye.csv", {}),
        ("industrial_calibration", arms / "rosi_positioner_2axis/measurements.yaml", {}),
        ("urdf", shared / "urdf/lwa4p_ipa320/lwa4p.urdf.xacro", {}),
    ]
    found = []
    for kind, path, options in given:
        copy = folder / f"real_{path.name}"
        copy.write_bytes(path.read_bytes())
        found.append(Sample(kind, copy, options))
    return found
