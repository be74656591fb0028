"""What every ring measures wrongly: as a table, and as the angle tables of two makers.

The makers' files replace the table by which a driver turns a ring into a direction. They start from
the table in rig.yaml's LiDAR model; a unit whose driver uses a table of its own should have that
one there, as `elevation_deg` and `azimuth_offset_deg`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.effects.beams import BeamOriginOffset
from calib.exporters.fitted import FittedRig, for_every_rig
from calib.exporters.written import NO_PLACE_FOR_SIGMAS, Unheld, Written, commented, write_text
from calib.results.rings import harmful
from sensors.documents import json_text

RING_OFFSETS = (("range", "m"), ("azimuth", "rad"), ("elevation", "rad"))
RING_CONVENTIONS = (
    "A row per ring, from 0 as the driver counts. measured = true + offset, so subtract offsets.",
    "range_m is along the beam, from where it starts; azimuth_rad counter-clockwise from x, seen",
    "from +z; elevation_rad up from the x-y plane; all in the LiDAR's own frame.",
)
HESAI = (
    "Channel counts from 1; Elevation is up, Azimuth clockwise seen from above, in degrees.",
    "table = that of the LiDAR model in rig.yaml - offset, measured = true + offset.",
)
FROM_THE_OTHER_END = "from the other end than the recording, whose ring 0 is its last channel"
OUSTER_ANGLES = {
    "angles": "degrees; altitude up, azimuth clockwise seen from above, as Ouster has them",
    "corrected": "table = that of the LiDAR model in rig.yaml - offset, measured = true + offset",
    "lidar_to_sensor_transform": "half a turn about z, no shift: points come in the frame 'lidar'"
    " of rig.yaml; mm",
    "lidar_origin_to_beam_origin_mm": "radial, mm",
}


@for_every_rig
def write_rings(fit: FittedRig, folder: Path) -> Written:
    """Write rings.csv: the offset of every ring, and sigma, of all effects by ring together.

    Raises:
        Unheld: the model has no effect by ring.
    """
    offset, sigma = _ring_errors(fit)
    table = {"ring": np.arange(len(offset))}
    for axis, (name, unit) in enumerate(RING_OFFSETS):
        if any(basis[:, axis].any() for basis in fit.by_ring.values()):
            table[f"{name}_offset_{unit}"] = offset[:, axis]
            table[f"{name}_sigma_{unit}"] = sigma[:, axis]
    not_held = fit.not_held(fit.by_ring)
    conventions = (*RING_CONVENTIONS, f"The sum of {', '.join(fit.by_ring)}; sigma is its own.")
    conventions += (f"Mind that {fit.odd_rings['sentence']}.",) if fit.odd_rings else ()
    rows = zip(*(column.tolist() for column in table.values()), strict=True)
    lines = [",".join(table), *(",".join(map(repr, row)) for row in rows), ""]
    path = fit.file(folder, "rings.csv")
    write_text(path, commented(fit.head(conventions, not_held)) + "\n".join(lines))
    return Written([path], not_held)


@for_every_rig
def write_hesai(fit: FittedRig, folder: Path) -> Written:
    """Write hesai_angle_correction.csv as Hesai's drivers read it. It has no place for comments:
    these stand beside it, in hesai_angle_correction.txt.

    Raises:
        Unheld: the LiDAR is not a Hesai, or the model has no angles by ring.
    """
    _refuse_other_maker(fit, "Hesai")
    _refuse_odd_rings(fit)
    if not _turning(fit):
        raise Unheld(
            "it holds the angles of rings, and the model has none; what it has of ranges by ring "
            "stands in rings.csv"
        )
    elevation_deg, azimuth_deg = _angles_deg(fit)
    angles = zip(elevation_deg, azimuth_deg, strict=True)
    rows = [f"{ring},{up!r},{aside!r}" for ring, (up, aside) in enumerate(angles, 1)]
    path = fit.file(folder, "hesai_angle_correction.csv")
    write_text(path, "\n".join(["Channel,Elevation,Azimuth", *rows, ""]))
    not_held = [_table(fit), *_not_in_a_table(fit, _turning(fit))]
    beside = fit.file(folder, "hesai_angle_correction.txt")
    write_text(beside, "\n".join([*fit.head((f"Of {path.name}:", *HESAI), not_held), ""]))
    warning = f"warnings: {'. '.join(fit.run.before_use)}"
    return Written([path, beside], [warning, *not_held] if fit.run.before_use else not_held)


@for_every_rig
def write_ouster(fit: FittedRig, folder: Path) -> Written:
    """Write ouster_metadata.json: the parts of a sensor's metadata that say where beams point.

    Raises:
        Unheld: the LiDAR is not an Ouster.
    """
    _refuse_other_maker(fit, "Ouster")
    _refuse_odd_rings(fit)
    lidar = fit.rig.lidar
    origins = [name for name, e in fit.effects.items() if isinstance(e, BeamOriginOffset)]
    moved = [fit.part.effects[name].estimate for name in origins]
    radial_m, tangential_m = sum(moved, lidar.beam_origin_m)
    altitude_deg, azimuth_deg = _angles_deg(fit)
    columns = lidar.columns
    metadata = {
        "beam_altitude_angles": altitude_deg,
        "beam_azimuth_angles": azimuth_deg,
        "lidar_origin_to_beam_origin_mm": 1e3 * radial_m,
        "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        "data_format": {
            "columns_per_frame": columns,
            "pixels_per_column": lidar.rings,
            "pixel_shift_by_row": [round(columns * angle / 360) for angle in azimuth_deg],
        },
    }
    not_held = [_table(fit), *_not_in_a_table(fit, [*_turning(fit), *origins])]
    if tangential_m:
        not_held.append(f"beams start {1e3 * tangential_m:.3f} mm to the left: no place for it")
    told = fit.head((), not_held)
    path = fit.file(folder, "ouster_metadata.json")
    write_text(path, json_text(metadata | {"rigcal": {"about": told, **OUSTER_ANGLES}}) + "\n")
    return Written([path], not_held)


def _ring_errors(fit: FittedRig) -> tuple[np.ndarray, np.ndarray]:
    if fit.rig.lidar is None:
        raise Unheld("the rig has no LiDAR")
    if not fit.by_ring:
        raise Unheld("the model has no effect by ring; 'rigcal effects' lists some")
    return fit.ring_errors()


def _refuse_other_maker(fit: FittedRig, maker: str) -> None:
    if fit.rig.lidar is None:
        raise Unheld("the rig has no LiDAR")
    if fit.rig.lidar.maker.lower() != maker.lower():
        raise Unheld(f"the LiDAR {fit.rig.lidar.name} is by {fit.rig.lidar.maker}, not {maker}")


def _refuse_odd_rings(fit: FittedRig) -> None:
    """A table by channel needs to know which ring is which channel."""
    if fit.odd_rings and harmful(fit.odd_rings["what"]):
        raise Unheld(f"it counts channels as the LiDAR does, and {fit.odd_rings['sentence']}")


def _turning(fit: FittedRig) -> list[str]:
    """Effects that turn rings for good."""
    return [name for name, basis in fit.by_ring.items() if basis[:, 1:].any()]


def _angles_deg(fit: FittedRig) -> tuple[list[float], list[float]]:
    """Elevation, up, and azimuth, clockwise, of every channel as the fit has them, in degrees.

    The model's table less the error: ``measured = true + error``. Makers' drivers look a beam up by
    its channel, as the model's table counts them, however a recording numbers the rings.
    """
    lidar, error = fit.rig.lidar, np.zeros((fit.rig.lidar.rings, 3))
    if fit.by_ring:
        error[fit.channels] = fit.ring_errors()[0]
    azimuth_rad = lidar.azimuth_offset_rad - error[:, 1]
    elevation_rad = lidar.elevation_rad - error[:, 2]
    return np.degrees(elevation_rad).tolist(), (0.0 - np.degrees(azimuth_rad)).tolist()


def _table(fit: FittedRig) -> str:
    model = fit.rig.lidar.name
    return (
        f"a unit's own angles: the table starts from the model {model} as rig.yaml has it, where "
        f"they can be given as elevation_deg and azimuth_offset_deg"
    )


def _not_in_a_table(fit: FittedRig, held: list[str]) -> list[str]:
    """What an angle table leaves out: sigmas, ranges, and all other effects."""
    both = [name for name in held if name in fit.by_ring and fit.by_ring[name][:, 0].any()]
    ranges = [f"{name}: its part of range" for name in both]
    counted = ["the numbers of rings: it counts channels as the LiDAR does, " + FROM_THE_OTHER_END]
    return [*(counted if fit.odd_rings else []), NO_PLACE_FOR_SIGMAS, *ranges, *fit.not_held(held)]
