"""The reference: hits against closed forms, surfaces and patches against known shapes."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from sensors.reference import Reference

ROOM_M = np.array([4.0, 3.0, 2.5])
STATION_M = np.array([1.3, 1.1, 1.2])
REAL = Path(__file__).parents[3] / "shared/data/recordings/known_nothing_hidden/reference"


def sheet(corner_m, u_m, v_m, steps=4, height=None):
    """Vertices and triangles of a parallelogram, divided into steps x steps x 2 triangles."""
    s, t = (a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, steps + 1)] * 2, indexing="ij"))
    vertices = np.array(corner_m) + s[:, None] * np.array(u_m) + t[:, None] * np.array(v_m)
    if height is not None:
        vertices = vertices + height(s, t)[:, None] * np.cross(u_m, v_m)
    i, j = (a.ravel() for a in np.meshgrid(*[np.arange(steps)] * 2, indexing="ij"))
    a, b = i * (steps + 1) + j, (i + 1) * (steps + 1) + j
    return vertices, np.concatenate(
        [np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)]
    )


def together(*parts):
    """One mesh of several; vertices on common edges stay repeated, as in scanned meshes."""
    start = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    return np.concatenate([v for v, _ in parts]), np.concatenate(
        [t + first for (_, t), first in zip(parts, start, strict=False)]
    )


def box(size_m=ROOM_M, steps=4):
    x, y, z = np.diag(size_m)
    return together(
        *[
            sheet(corner, u, v, steps)
            for corner, u, v in [
                (0 * x, y, z), (x, y, z), (0 * y, x, z), (y, x, z), (0 * z, x, y), (z, x, y),
            ]
        ]
    )  # fmt: skip


def random_directions(count, seed=0):
    towards = np.random.default_rng(seed).normal(size=(count, 3))
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def range_in_box(origin_m, directions):
    """Closed form: the nearest of the six walls from inside."""
    wall_m = np.where(directions > 0, ROOM_M, 0.0)
    return ((wall_m - origin_m) / directions).min(axis=1)


@pytest.fixture(scope="module")
def room():
    return Reference(*box())


# ---- hits


def test_hits_in_a_box_are_exact(room):
    directions = random_directions(20000)
    hits = room.cast(np.broadcast_to(STATION_M, directions.shape), directions)
    expected_m = range_in_box(STATION_M, directions)
    assert np.abs(hits.range_m - expected_m).max() < 1e-13
    assert np.allclose(hits.point_m, STATION_M + expected_m[:, None] * directions, atol=1e-13)
    facing = -np.einsum("ni,ni->n", hits.normal, directions)
    assert facing.min() > 0
    assert np.allclose(hits.incidence_rad, np.arccos(facing), atol=1e-7)
    assert np.allclose(np.abs(hits.normal).max(axis=1), 1)
    wall = np.abs(hits.normal).argmax(axis=1)
    on_wall_m = hits.point_m[np.arange(len(wall)), wall]
    assert np.allclose(np.minimum(on_wall_m, ROOM_M[wall] - on_wall_m), 0, atol=1e-12)


@pytest.mark.parametrize("away_m", [100.0, 500_000.0])
def test_a_mesh_far_from_its_origin_keeps_triangle_and_range(away_m):
    """Left where it is, in float32, a mesh 500 km away gives most beams a wrong triangle."""
    vertices, triangles = together(box(), sheet([2, 1, 0], [0.3, 0, 0], [0, 0.1, 1], steps=30))
    shift_m = away_m * np.array([1.0, -0.7, 0.01])
    directions = random_directions(20000)
    near = Reference(vertices, triangles).cast(STATION_M, directions)
    far = Reference(vertices + shift_m, triangles).cast(STATION_M + shift_m, directions)
    # A beam within rounding of an edge may take either neighbour.
    same = near.triangle == far.triangle
    assert np.mean(same) > 0.9998
    assert np.abs(far.range_m - near.range_m)[same].max() < 1e-14 * away_m + 1e-12
    assert np.allclose((far.point_m - shift_m - near.point_m)[same], 0, atol=1e-8)


def test_hits_of_given_triangles_extend_their_planes():
    reference = Reference([[0, 0, 2], [1, 0, 2], [0, 1, 2]], [[0, 1, 2]])
    origins_m = np.zeros((5, 3))
    directions = np.array([[0.6, 0.0, 0.8], [-0.6, 0, 0.8], [0, 0, -1], [1, 0, 0], [0, 0, 1]])
    triangle = np.array([0, 0, 0, 0, -1])
    hits = reference.hits(triangle, origins_m, directions)
    assert np.array_equal(hits.triangle, [0, 0, -1, -1, -1])
    assert np.array_equal(triangle, [0, 0, 0, 0, -1])
    assert np.allclose(hits.range_m, [2.5, 2.5, np.inf, np.inf, np.inf])
    assert np.allclose(hits.point_m[:2], [[1.5, 0, 2], [-1.5, 0, 2]])
    assert np.array_equal(hits.normal, [[0, 0, -1], [0, 0, -1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert np.array_equal(hits.label, [0, 0, -1, -1, -1])
    assert np.allclose(hits.incidence_rad[2:], np.pi / 2)
    assert not np.isnan(hits.point_m).any()


def test_given_triangles_make_the_range_differentiable(room):
    """Closed form with the plane held: d range / d origin = -n / (n.d)."""
    directions = random_directions(200, seed=3)
    hits = room.cast(STATION_M, directions)
    again = room.hits(hits.triangle, STATION_M, directions)
    assert np.array_equal(again.range_m, hits.range_m)
    expected = -hits.normal / np.einsum("ni,ni->n", hits.normal, directions)[:, None]
    for axis, step in enumerate(1e-5 * np.eye(3)):
        ahead = room.hits(hits.triangle, STATION_M + step, directions).range_m
        behind = room.hits(hits.triangle, STATION_M - step, directions).range_m
        assert np.allclose((ahead - behind) / 2e-5, expected[:, axis], rtol=1e-6, atol=1e-8)


def test_a_beam_into_the_open_misses():
    reference = Reference(*sheet([0, 0, 2], [1, 0, 0], [0, 1, 0]), intensity=np.full(32, 7.0))
    hits = reference.cast([0.5, 0.5, 0.0], np.array([[0.0, 0, 1], [0, 0, -1], [0.8, 0, 0.6]]))
    assert hits.triangle[0] >= 0
    assert np.array_equal(hits.triangle[1:], [-1, -1])
    assert np.array_equal(hits.range_m, [2.0, np.inf, np.inf])
    assert hits.intensity[0] == 7.0
    assert np.isnan(hits.intensity[1:]).all()


def test_label_and_intensity_are_those_of_the_triangle():
    vertices, triangles = box(steps=2)
    label, intensity = np.arange(len(triangles)) % 5, np.arange(len(triangles)) / 10.0
    reference = Reference(vertices, triangles, label, intensity, {0: "floor", 3: "foam"})
    hits = reference.cast(STATION_M, random_directions(500))
    assert np.array_equal(hits.label, hits.triangle % 5)
    assert np.array_equal(hits.intensity, hits.triangle / 10.0)
    assert reference.label_names == {
        0: "floor", 1: "label_1", 2: "label_2", 3: "foam", 4: "label_4",
    }  # fmt: skip


def test_triangles_without_area_are_holes():
    """A point, a line and a sliver stand before a wall: beams pass, and nothing becomes NaN."""
    vertices, triangles = sheet([-1, -1, 2], [2, 0, 0], [0, 2, 0])
    bad = np.array(
        [[0, 0, 1], [0, 0, 1], [0, 0, 1], [-1, 0, 1], [0, 0, 1], [1, 0, 1],
         [-1, 0, 1], [1, 0, 1], [0, 1e-13, 1]], dtype=float,
    )  # fmt: skip
    reference = Reference(
        np.concatenate([bad, vertices]), np.concatenate([np.arange(9).reshape(3, 3), triangles + 9])
    )
    directions = np.array([[0.0, 0, 1], [0.1, 0, 1], [0.1, 0.1, 1]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = reference.cast(np.zeros(3), directions)
    clean = Reference(vertices, triangles).cast(np.zeros(3), directions)
    assert np.array_equal(hits.triangle, clean.triangle + 3)
    assert np.allclose(hits.point_m[:, 2], 2)
    forced = reference.hits(np.array([0, 1, 2]), np.zeros(3), directions)
    assert np.array_equal(forced.triangle, [-1, -1, -1])
    assert np.all(forced.range_m == np.inf)
    assert not np.isnan(forced.point_m).any()
    assert np.array_equal(reference.area_m2[:3], np.zeros(3))
    assert np.all(reference.patch(hits.triangle, hits.point_m) >= 0)


def test_a_reference_travels_after_it_has_cast(room):
    directions = random_directions(50)
    before = room.cast(STATION_M, directions)
    after = pickle.loads(pickle.dumps(room)).cast(STATION_M, directions)
    assert np.array_equal(before.range_m, after.range_m)


# ---- surfaces and patches


def surfaces(mesh, label=None):
    return len(np.unique(Reference(*mesh, label).surface))


def test_a_box_has_six_surfaces(room):
    assert len(np.unique(room.surface)) == 6
    wall = np.abs(room.vertices_m[room.triangles].std(axis=1)).argmin(axis=1)
    for surface in range(6):
        assert len(np.unique(wall[room.surface == surface])) == 1


def test_repeated_vertices_and_either_winding_do_not_divide_a_surface():
    vertices, triangles = sheet([0, 0, 0], [1, 0, 0], [0, 1, 0])
    loose = vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    loose[0][:, 2] += 1e-8 * np.random.default_rng(0).normal(size=len(loose[0]))
    assert surfaces(loose) == 1
    turned = triangles.copy()
    turned[::3] = turned[::3, ::-1]
    assert surfaces((vertices, turned)) == 1


@pytest.mark.parametrize(("fold_deg", "count"), [(25.0, 1), (35.0, 2), (90.0, 2), (175.0, 2)])
def test_a_fold_of_thirty_degrees_divides(fold_deg, count):
    fold = np.radians(fold_deg)
    mesh = together(
        sheet([0, 0, 0], [1, 0, 0], [0, 1, 0]),
        sheet([1, 0, 0], [np.cos(fold), 0, np.sin(fold)], [0, 1, 0]),
    )
    assert surfaces(mesh) == count
    vertices, triangles = mesh
    triangles[32:] = triangles[32:, ::-1]
    assert surfaces((vertices, triangles)) == count


def test_labels_divide_a_plane():
    vertices, triangles = sheet([0, 0, 0], [1, 0, 0], [0, 1, 0])
    left = vertices[triangles].mean(axis=1)[:, 0] < 0.5
    assert surfaces((vertices, triangles), left) == 2


def test_a_bumpy_wall_is_one_surface():
    def bumps(s, t):
        return 0.03 * np.sin(9 * s) * np.cos(11 * t)

    assert surfaces(sheet([0, 0, 0], [1, 0, 0], [0, 1, 0], steps=30, height=bumps)) == 1


def test_a_floor_goes_on_where_a_wall_stands_on_it():
    """Four triangles share each edge along the wall's foot."""
    floor_left = sheet([0, 0, 0], [1, 0, 0], [0, 1, 0])
    floor_right = sheet([1, 0, 0], [1, 0, 0], [0, 1, 0])
    wall = sheet([1, 0, 0], [0, 0, 1], [0, 1, 0])
    cellar = sheet([1, 0, 0], [0, 0, -1], [0, 1, 0])
    for order in ([floor_left, wall, cellar, floor_right], [wall, floor_right, cellar, floor_left]):
        assert surfaces(together(*order)) == 2


def test_patches_are_even_cells_of_one_surface(room):
    hits = room.cast(STATION_M, random_directions(20000))
    patch, owner = room.patch(hits.triangle, hits.point_m, 0.5), room.patch_surface(0.5)
    assert np.array_equal(owner[patch], room.surface[hits.triangle])
    assert len(owner) == 2 * (8 * 6 + 8 * 5 + 6 * 5)
    assert np.array_equal(np.unique(patch), np.arange(len(owner)))
    low, high = np.full((len(owner), 3), np.inf), np.full((len(owner), 3), -np.inf)
    np.minimum.at(low, patch, hits.point_m)
    np.maximum.at(high, patch, hits.point_m)
    assert (high - low).max() <= 0.5 + 1e-9
    assert len(room.patch_surface(0.7)) == 2 * (6 * 4 + 6 * 4 + 4 * 4)


def test_where_in_its_patch_a_beam_ends(room):
    """Along two axes in the surface: patches' middles are 0, and steps there are steps along it."""
    hits = room.cast(STATION_M, random_directions(20000))
    triangle, patch = hits.triangle, room.patch(hits.triangle, hits.point_m, 0.5)
    away_m = room.from_middle_m(triangle, hits.point_m, 0.5)
    assert np.abs(away_m).max() <= 0.25 + 1e-9 and np.abs(away_m).max() > 0.24
    low, high = np.full((patch.max() + 1, 3), np.inf), np.full((patch.max() + 1, 3), -np.inf)
    np.minimum.at(low, patch, hits.point_m)
    np.maximum.at(high, patch, hits.point_m)
    middle_m = (low + high)[patch] / 2
    whole = (high - low)[patch].sum(axis=1) > 0.9  # of many beams
    off_m = np.linalg.norm(away_m, axis=1) - np.linalg.norm(hits.point_m - middle_m, axis=1)
    assert np.abs(off_m[whole]).max() < 0.05 and whole.sum() > 5000
    order = np.argsort(patch)
    first, second = (each[np.diff(patch[order]) == 0] for each in (order[:-1], order[1:]))
    apart_m = np.linalg.norm(hits.point_m[first] - hits.point_m[second], axis=1)
    np.testing.assert_allclose(np.linalg.norm(away_m[first] - away_m[second], axis=1), apart_m)
    assert not room.from_middle_m(np.full(1, -1), np.full((1, 3), np.inf), 0.5).any()


def curtain(wave_m=0.03, noise_m=0.0, steps=30):
    """A sheet of 2 m with five waves across it."""
    vertices, triangles = sheet([0, 0, 0], [2, 0, 0], [0, 0, 2], steps)
    rng = np.random.default_rng(3)
    vertices[:, 1] += wave_m * np.sin(5 * np.pi * vertices[:, 0])
    vertices[:, 1] += noise_m * rng.standard_normal(len(vertices))
    return vertices, triangles


def test_patches_of_a_curved_surface_are_apart_by_the_way_they_face():
    """What a shift of the whole does to the offset along the normal is nearly even on each; and the
    numbers of all other patches are as they were."""
    mesh = Reference(*together(curtain(), sheet([0, 3, 0], [2, 0, 0], [0, 0, 2], steps=20)))
    triangle = np.arange(len(mesh.triangles))
    middle_m = mesh.vertices_m[mesh.triangles].mean(axis=1)
    whole = mesh.patch(triangle, middle_m, 0.5)
    parts = mesh.patch(triangle, middle_m, 0.5, by_way=True)
    flat = middle_m[:, 1] > 2.0
    np.testing.assert_array_equal(parts[flat], whole[flat])
    assert (parts[~flat] > whole.max()).all()
    owner = mesh.patch_surface(0.5, by_way=True)
    np.testing.assert_array_equal(owner[parts], mesh.surface)
    np.testing.assert_array_equal(owner[: len(mesh.patch_surface(0.5))], mesh.patch_surface(0.5))
    normal = mesh.planes[:-1, :3]
    for part in np.unique(parts[~flat]):
        here = parts == part
        assert len(np.unique(whole[here])) == 1
        assert np.ptp(normal[here], axis=0).max() < 0.11
        centre_m = mesh.patch_centre_m(int(part), 0.5)
        np.testing.assert_allclose(centre_m, middle_m[here].mean(axis=0), atol=0.01)
    assert len(np.unique(parts[~flat])) == 3 * len(np.unique(whole[~flat])), "slopes of a wave"


def test_a_noisy_wall_is_not_curved():
    """Noise of 1.5 mm turns triangles of 17 mm by 10 degrees."""
    mesh = Reference(*curtain(wave_m=0.0, noise_m=0.0015, steps=120))
    turned = np.arccos(np.abs(mesh.planes[:-1, 1]))
    assert np.sqrt(np.mean(np.square(turned))) > np.radians(8.0)
    np.testing.assert_array_equal(mesh.patch_surface(0.5, by_way=True), mesh.patch_surface(0.5))


def test_patches_of_a_plane_extended_and_of_misses(room):
    directions = random_directions(100)
    hits = room.cast(STATION_M, directions)
    beyond = room.hits(hits.triangle, STATION_M + np.array([50.0, 0, 0]), directions)
    patch = room.patch(beyond.triangle, beyond.point_m)
    missed = beyond.triangle < 0
    assert missed.any()
    assert (~missed).any()
    assert np.all(patch[missed] == -1)
    assert np.array_equal(
        room.patch_surface()[patch[~missed]], room.surface[beyond.triangle[~missed]]
    )


def test_facts_are_those_of_the_triangle_and_of_none(room):
    hits = room.cast(STATION_M, random_directions(50))
    triangle = np.append(hits.triangle, -1)
    label, intensity, surface = room.facts(triangle)
    np.testing.assert_array_equal(label, np.append(room.label[hits.triangle], -1))
    np.testing.assert_array_equal(intensity, np.append(room.intensity[hits.triangle], np.nan))
    np.testing.assert_array_equal(surface, np.append(room.surface[hits.triangle], -1))


def test_planes_hold_their_triangles_corners_and_the_last_is_met_by_nothing(room):
    corners_m = room.vertices_m[room.triangles]
    normal, distance_m = room.planes[:-1, :3], room.planes[:-1, 3]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    across_m = np.einsum("fi,fki->fk", normal, corners_m) - distance_m[:, None]
    np.testing.assert_allclose(across_m, 0.0, atol=1e-9)
    assert len(room.planes) == len(room.triangles) + 1
    nowhere = room.hits(np.array([-1]), STATION_M, np.array([[1.0, 0.0, 0.0]]))
    assert nowhere.triangle == -1 and np.isinf(nowhere.range_m)


# ---- depth edges


def test_beams_near_the_rim_of_a_plate_are_near_an_edge():
    """A tall plate 1 m wide, 2 m away, before a wall."""
    plate = sheet([2, -0.5, -2], [0, 1, 0], [0, 0, 4])
    wall = sheet([3, -4, -4], [0, 8, 0], [0, 0, 8])
    reference = Reference(*together(plate, wall))
    y, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.8, 0.8, 161)] * 2))
    directions = np.column_stack([np.full(len(y), 2.0), y, z])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angle_rad = 0.02
    near = reference.near_edge(
        np.zeros(3), directions, reference.cast(np.zeros(3), directions), angle_rad
    )
    # A beam turned by the angle meets the plate's plane 2 m tan(angle) away, and further the more
    # obliquely it looks.
    from_rim_m = np.abs(np.abs(y) - 0.5)
    assert np.all(near[from_rim_m < 1.9 * angle_rad])
    assert not np.any(near[from_rim_m > 2.6 * angle_rad])


def test_a_beam_is_near_no_edge_inside_a_surface_or_on_a_small_step():
    bumps = sheet([2, -1, -1], [0, 2, 0], [0, 0, 2], 20, lambda s, t: 0.001 * np.sin(40 * s))
    reference = Reference(*bumps)
    directions = np.array([[1.0, 0, 0], [0.8, 0.1, 0.0], [0, 0, 1]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = reference.cast(np.zeros(3), directions)
    assert np.array_equal(hits.triangle >= 0, [True, True, False])
    assert not reference.near_edge(np.zeros(3), directions, hits, 0.01).any()
    assert np.array_equal(
        reference.near_edge(np.zeros(3), directions, hits, [0.9, 0.01, 0.9]), [True, False, False]
    )
