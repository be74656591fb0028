"""Readers of foreign files: one format, one file. A new one is a function and a line here."""

from sensors.readers.arms.dh import read_dh
from sensors.readers.arms.urdf import read_urdf
from sensors.readers.bags.bag import read_bag
from sensors.readers.base import Reader
from sensors.readers.clouds.files import (
    read_e57,
    read_kitti,
    read_las,
    read_numpy,
    read_nuscenes,
    read_pcd,
    read_ply,
)
from sensors.readers.meshes.mesh import read_meshes
from sensors.readers.meshes.spheres import read_spheres
from sensors.readers.meshes.survey import read_survey
from sensors.readers.packets.hesai import read_hesai
from sensors.readers.packets.ouster import read_ouster
from sensors.readers.poses.industrial_calibration import read_industrial_calibration
from sensors.readers.poses.motive import read_motive
from sensors.readers.poses.trajectory import read_euroc, read_tum
from sensors.readers.poses.vicon import read_vicon
from sensors.readers.tables.table import read_table

READERS: dict[str, Reader] = {
    reader.kind: reader
    for reader in (
        Reader("bag", "ROS 1 and ROS 2 bags, MCAP: LiDAR, joints, poses", read_bag, "ros"),
        Reader("dh", "an arm as a table of Denavit and Hartenberg (YAML, CSV)", read_dh),
        Reader("e57", "clouds with rows and columns, a stop for each scan", read_e57, "e57"),
        Reader("euroc", "a trajectory of EuRoC, or its IMU's gyro (CSV)", read_euroc),
        Reader("hesai", "packets (PCAP), with the table of angles", read_hesai),
        Reader(
            "industrial_calibration",
            "joints and poses of a target (YAML)",
            read_industrial_calibration,
        ),
        Reader("kitti", "clouds (.bin): x y z intensity", read_kitti),
        Reader("las", "clouds (LAS, LAZ), a stop for each", read_las, "las"),
        Reader("mesh", "the scanned room: PLY, OBJ, STL, GLB with labels", read_meshes, "mesh"),
        Reader("motive", "rigid bodies and markers of OptiTrack (CSV, all formats)", read_motive),
        Reader("numpy", "clouds (.npy, .npz), a stop for each", read_numpy),
        Reader("nuscenes", "clouds (.pcd.bin): x y z intensity ring", read_nuscenes),
        Reader("ouster", "packets (PCAP, with its JSON) and OSF", read_ouster),
        Reader("pcd", "clouds (PCD), a stop for each", read_pcd),
        Reader("ply", "clouds (PLY), a stop for each", read_ply),
        Reader("spheres", "centres of spheres: FARO's list, or clouds of them", read_spheres),
        Reader("survey", "clouds of a surveying scanner: E57, PTS, PTX, PLY", read_survey, "e57"),
        Reader("table", "any table with a header: a log, or a row for every stop", read_table),
        Reader("tum", "a trajectory of TUM (t x y z qx qy qz qw)", read_tum),
        Reader("urdf", "an arm as URDF or xacro, with its SRDF", read_urdf, "xacro"),
        Reader("vicon", "bodies and markers of Nexus or Tracker (CSV)", read_vicon),
    )
}
