"""The scanned room written as the reference of a recording, and read back."""

import numpy as np

from calib.intake.surface import write_surface
from sensors.readers.base import ScannedSurface
from sensors.reference import Reference


def test_a_surface_written_is_the_reference_read(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1]]) + 4e5
    surface = ScannedSurface(
        vertices_m=corners,
        triangles=np.array([[0, 1, 2], [0, 2, 3]]),
        label=np.array([2, 7], np.uint16),
        intensity=np.array([0.25, 0.5]),
        names={2: "wall"},
    )
    write_surface(surface, tmp_path)
    files = [tmp_path / "reference" / f for f in ("mesh.ply", "faces.parquet", "labels.yaml")]
    back = Reference.read(*files)
    assert np.array_equal(back.vertices_m, corners)
    assert np.array_equal(back.triangles, surface.triangles)
    assert back.label.tolist() == [2, 7]
    assert back.intensity.tolist() == [0.25, 0.5]
    assert back.label_names == {2: "wall", 7: "label_7"}
