"""The 3-D part of the page: the room, the rig and the points, as nodes of viser's scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.rig.shapes import Shape
from calib.view import scene as scenes
from calib.view.plans.ghosts import PLANNED_PATH, Ghost, draw, ghosts
from calib.view.scene import Points, Scene
from calib.view.shown import sizes
from calib.view.shown.area import Area
from calib.view.shown.drawn import drawn_shapes
from calib.view.shown.moves import TIMES, Move, moves
from chains import se3

ROOM_PATH, RIG_PATH, AXES_PATH, MOVES_PATH = "/room", "/rig", "/axes", "/moves"
POINTS, LIT, PICKED, NAME_PATH = "/points", "/lit", "/picked", "/run"
BESIDE_PATH = "/beside"  # under which the room of another run stands
ARM_COLOUR, MOUNT_COLOUR, ROOM_COLOUR = (60, 70, 85), (150, 155, 165), (236, 236, 232)
SHAPE_COLOUR = (196, 201, 208)
SURE_COLOUR, UNSURE_COLOUR = (200, 30, 120), (150, 155, 165)  # of moves from CAD
HEAD_M = 0.06  # of an arrow that is long enough
THICK_M, THIN_M = 0.05, 0.015
FINEST_M, COARSEST = 0.006, 1 / 350  # of a point: metres, and a share of the room
LARGER = 1.4  # points that are lit, among others
APART = 1.08  # two rooms, in widths or heights of one
# Than two rooms as large as they are in their middle: the nearer parts are larger.
FARTHER_FOR_TWO = 1.2
BEHIND_M = 0.01  # the room is drawn so far behind its surface
OVERHEAD = 0.75  # of the way from the LiDAR to the ceiling: points above that hide the rest
LETTER_M = 0.03  # frames are centimetres apart: their names are read from close by
PANEL_PX, PLOT_PX = 400, 380  # widths of the panels to the right and to the left of the picture
NARROW_PX = 1200  # of a window with hardly room for a picture between two panels
FOV_RAD = np.radians(50.0)


class Drawing:
    """What one browser draws, about the room's middle, as browsers have single precision.

    Args:
        client: viser's, of that browser.
        window_px: width and height of its window, the panels included.
        camera: where the eye stands and what it looks at, as `camera` has it; None: as shows all.
        shift_m: (3,) by which all of it stands elsewhere; None: where it is, and the camera is
            aimed at it.
    """

    def __init__(
        self,
        client: Any,
        window_px: tuple[int, int],
        camera: tuple[float, ...] | None = None,
        shift_m: np.ndarray | None = None,
    ) -> None:
        self.client, self._window_px, self._camera = client, window_px, camera
        self.shift_m, self._root = np.zeros(3), ""
        if shift_m is not None:
            self.shift_m, self._root = np.asarray(shift_m, float), BESIDE_PATH
            client.scene.add_frame(BESIDE_PATH, show_axes=False, position=self.shift_m)
        self.scene: Scene | None = None
        self.points: Points | None = None
        self.shown = np.zeros(0, int)
        self.moves: Sequence[Move] = ()
        self.ghosts: Sequence[Ghost] = ()
        self._middle_m = np.zeros(3)
        self._box = np.zeros((2, 3))
        self.lines_why = ""
        self._shapes: Sequence[Shape] = ()
        self._room: tuple[str, str] | None = None
        self._around: np.ndarray | None = None
        self.hidden = {MOVES_PATH, PLANNED_PATH}
        client.scene.configure_default_lights(cast_shadow=False)

    @property
    def room(self) -> tuple[str, str] | None:
        """Of which recording the room is drawn; None where none is."""
        return self._room

    def clear(self) -> None:
        """Draw nothing."""
        self.scene, self.points, self._room = None, None, None
        clouds = [name for each in (POINTS, LIT) for name in self._clouds(each)]
        parts = (ROOM_PATH, RIG_PATH, AXES_PATH, MOVES_PATH, PLANNED_PATH)
        for name in (*parts, PICKED, NAME_PATH, *clouds):
            self._remove(name)

    def remove(self) -> None:
        """Draw nothing, ever more."""
        self.clear()
        if self._root:
            self.client.scene.remove_by_name(self._root)

    def _at(self, name: str) -> str:
        return self._root + name

    def _remove(self, name: str) -> None:
        self.client.scene.remove_by_name(self._at(name))

    def _clouds(self, name: str) -> list[str]:
        """The clouds of points of one name, by the size of dots; the first is of the usual one."""
        return [name, *(f"{name}{i}" for i in range(len(sizes.FACTORS)))]

    def call(self, text: str) -> None:
        """Write a name above the room; an empty one takes it away."""
        self._remove(NAME_PATH)
        if text:
            low, high = self._box
            top = [*(low[:2] + high[:2]) / 2, high[2] + 0.05 * (high[2] - low[2])]
            self.client.scene.add_label(
                self._at(NAME_PATH),
                text,
                position=top,
                anchor="bottom-center",
                font_screen_scale=1.2,
            )

    def open(self, scene: Scene, recording: int) -> None:
        """Draw another run's room; the same one is not sent again."""
        self.scene = scene
        known = scene.run.model["recordings"][recording]
        if self._room == (known["path"], known["sha256"]):
            return
        self.clear()
        self.scene, self._room = scene, (known["path"], known["sha256"])
        room = scene.room(recording)
        first = scene.stops(recording)[0]
        around = room[0] if room else self._extent(recording, first)
        self._middle_m = np.mean(scenes.box(around), axis=0)
        self._box = np.array(scenes.box(around)) - self._middle_m
        self._open_shapes(recording)
        if room:
            # Half of every point would be inside the wall that it lies on.
            vertices = scenes.sunk(*room, BEHIND_M) - self._middle_m
            self.client.scene.add_mesh_simple(
                self._at(ROOM_PATH),
                vertices,
                room[1],
                color=ROOM_COLOUR,
                side="front",
                flat_shading=True,
                visible=ROOM_PATH not in self.hidden,
            )

    def _open_shapes(self, recording: int) -> None:
        """Send the meshes of the arm's links, which `_draw_rig` puts in their places."""
        self._shapes, self.lines_why = drawn_shapes(self.scene.sources[recording].rig)
        scene = self.client.scene
        scene.add_frame(self._at(RIG_PATH), show_axes=False, visible=RIG_PATH not in self.hidden)
        for i, shape in enumerate(self._shapes):
            scene.add_mesh_simple(
                f"{self._at(RIG_PATH)}/shape{i}",
                shape.vertices_m.astype(np.float32),
                shape.triangles,
                color=SHAPE_COLOUR,
                side="double",
                flat_shading=True,
            )

    def show(self, recording: int, stop: str, points: Points | None) -> None:
        """Draw the rig at a stop, and take these points, which `paint` draws."""
        self._remove(PICKED)
        self._draw_rig(recording, stop)
        self.moves = moves(self.scene, recording, stop)
        self._draw_moves()
        self.ghosts = ghosts(self.scene, recording)
        where, seen = self._at(PLANNED_PATH), PLANNED_PATH not in self.hidden
        draw(self.client.scene, where, self.ghosts, self._middle_m, seen)
        self.points = points
        if points is None:
            self.show_no_points()
        if self._around is None and not self._root:
            self._around = self._extent(recording, stop) - self._middle_m
            self._aim()

    def show_no_points(self) -> None:
        """Draw the room and the rig alone."""
        self.points = None
        for name in (*self._clouds(POINTS), *self._clouds(LIT)):
            self._remove(name)

    def camera(self) -> tuple[float, ...]:
        """Where the eye stands (3), and what it looks at (3), m from the room's middle."""
        camera = self.client.camera
        return (*map(float, camera.position), *map(float, camera.look_at))

    def ceiling_m(self) -> tuple[float, float, float]:
        """Height of the lowest and highest point, and that below which the view is free."""
        low, high = self.points.xyz_m[:, 2].min(), self.points.xyz_m[:, 2].max()
        eye = self.points.eye_m[2]
        return float(low), float(high), float(eye + OVERHEAD * max(high - eye, 0.0))

    def paint(
        self,
        colours: np.ndarray,
        below_m: float,
        kept: np.ndarray,
        lit: np.ndarray | None = None,
        steps: np.ndarray | None = None,
    ) -> int:
        """Draw the points that are kept (N,) in their colours (N, 3) uint8, in sizes by `steps`
        (N,), as `sizes` has them, those that are lit (N,) larger; how many they are."""
        points = self.points
        self.shown = points.drawn(below_m, among=kept)
        span = float(np.linalg.norm(np.subtract(*scenes.box(points.xyz_m))))
        size = float(np.clip(span / 2 / np.sqrt(len(self.shown) + 1), FINEST_M, span * COARSEST))
        large = np.zeros(len(self.shown), bool) if lit is None else lit[self.shown]
        some = np.full(len(self.shown), -1) if steps is None else steps[self.shown]
        for name, these, scale in ((POINTS, ~large, size), (LIT, large, size * LARGER)):
            for step, (cloud, factor) in enumerate(
                zip(self._clouds(name), (1.0, *sizes.FACTORS), strict=True), start=-1
            ):
                chosen = self.shown[these & (some == step)]
                self._draw_points(cloud, chosen, colours, scale * factor)
        return len(self.shown)

    def _draw_points(self, name: str, some: np.ndarray, colours: np.ndarray, size_m: float) -> None:
        if not len(some):
            self._remove(name)
            return
        self.client.scene.add_point_cloud(
            self._at(name),
            (self.points.xyz_m[some] - self._middle_m).astype(np.float32),
            colours[some],
            point_size=size_m,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def pick(self, origin_m: np.ndarray, direction: np.ndarray) -> int | None:
        """The point that was clicked, which is marked; None where the click met none."""
        if self.points is None or not len(self.shown):
            return None
        origin_m = origin_m - self.shift_m
        index = self.points.picked(self.shown, origin_m + self._middle_m, direction)
        if index is None:
            self._remove(PICKED)
        else:
            at = self.points.xyz_m[index] - self._middle_m
            distance = np.linalg.norm(at - origin_m)
            self.client.scene.add_icosphere(
                self._at(PICKED), radius=0.006 * distance, color=(0, 0, 0), position=at
            )
        return index

    def _extent(self, recording: int, stop: str) -> np.ndarray:
        """Points (N, 3) about which the stop's picture is."""
        points = self.scene.points(recording, stop)
        if points is not None:
            return points.xyz_m
        frames = self.scene.frames(recording, stop).values()
        return np.array([T[:3, 3] for T in frames])

    def _draw_rig(self, recording: int, stop: str) -> None:
        scene = self.client.scene
        self._remove(AXES_PATH)
        for i, shape in enumerate(self._shapes):
            T = self.scene.place(recording, stop, shape.link)
            node = scene.get_handle_by_name(f"{self._at(RIG_PATH)}/shape{i}")
            node.wxyz, node.position = se3.to_quat_wxyz(T), T[:3, 3] - self._middle_m
        shaped = {shape.link for shape in self._shapes}
        links, arm = self.scene.links(recording, stop, shaped)
        for part, thick, colour, name in (
            (arm, THICK_M, ARM_COLOUR, "arm"),
            (~arm, THIN_M, MOUNT_COLOUR, "mounts"),
        ):
            if part.any():
                ends = links[part] - self._middle_m
                scene.add_line_segments(
                    f"{self._at(RIG_PATH)}/{name}", ends, colour, thickness=thick
                )
        for i, end in enumerate(links[arm].reshape(-1, 3)[1::2] - self._middle_m):
            scene.add_icosphere(
                f"{self._at(RIG_PATH)}/joint{i}", THICK_M * 0.75, ARM_COLOUR, position=end
            )
        scene.add_frame(self._at(AXES_PATH), show_axes=False, visible=AXES_PATH not in self.hidden)
        for name, T in self.scene.frames(recording, stop).items():
            at = T[:3, 3] - self._middle_m
            scene.add_frame(
                f"{self._at(AXES_PATH)}/{name}",
                axes_length=0.12,
                axes_radius=0.006,
                wxyz=se3.to_quat_wxyz(T),
                position=at,
            )
            scene.add_label(
                f"{self._at(AXES_PATH)}/{name}/name",
                name,
                font_size_mode="scene",
                font_scene_height=LETTER_M,
            )

    def _draw_moves(self) -> None:
        """An arrow for each link, those that are hardly chance in their colour."""
        scene = self.client.scene
        self._remove(MOVES_PATH)
        scene.add_frame(
            self._at(MOVES_PATH), show_axes=False, visible=MOVES_PATH not in self.hidden
        )
        for i, move in enumerate(self.moves):
            arrow = move.arrow_m - self._middle_m
            head = min(HEAD_M, TIMES * move.length_m / 2)
            scene.add_arrows(
                f"{self._at(MOVES_PATH)}/{i}",
                arrow[None],
                SURE_COLOUR if move.sure else UNSURE_COLOUR,
                shaft_radius=head / 6,
                head_radius=head / 2.5,
                head_length=head,
            )
            if move.sure:  # others are short, and their names would hide each other
                scene.add_label(
                    f"{self._at(MOVES_PATH)}/{i}/name",
                    move.text,
                    position=arrow[1],
                    font_size_mode="scene",
                    font_scene_height=LETTER_M,
                )

    def toggle(self, name: str) -> None:
        """Hide the room, the rig, its axes, its moves or planned stops; or show it again."""
        self.hidden ^= {name}
        node = self.client.scene.get_handle_by_name(self._at(name))
        if node is not None:
            node.visible = name not in self.hidden

    def _aim(self) -> None:
        """Let the person at the page look at all of it, from above one corner."""
        client = self.client
        # The panels stand beside the picture, or below it on a phone.
        width, height = self._window_px
        width -= PLOT_PX if width >= NARROW_PX else 0
        width -= PANEL_PX if width > 1.5 * PANEL_PX else 0
        wide = min(1.0, width / max(height, 1))  # the angle of view is the height's
        angle = 2 * np.arctan(np.tan(FOV_RAD / 2) * wide)
        client.camera.fov = FOV_RAD
        known, self._camera = self._camera, None
        if known:
            self._look((known[:3], known[3:]))
        else:
            self._look(scenes.camera(*scenes.box(self._around), angle))

    def area(self, corners: Sequence[Sequence[float]]) -> Area:
        """What is seen between two corners of the picture, in its widths and heights; as from the
        room that stands where it is."""
        camera = self.client.camera
        eye = camera.position + self._middle_m, np.array(camera.wxyz)
        return Area.drawn(eye, camera.fov, camera.aspect, corners)

    def step_aside(self) -> np.ndarray:
        """By how much (3,) another room has to stand elsewhere to be seen beside this one, or below
        it where the picture is high; the camera moves so that both are seen."""
        shift_m, farther = self._apart()
        self._camera = self.camera()
        back = np.subtract(self._camera[:3], self._camera[3:])
        self._look((shift_m / 2 + farther * back, shift_m / 2))
        return shift_m

    def step_back(self) -> None:
        """Look at this room alone, as before another stood beside it."""
        self._aim()

    def _apart(self) -> tuple[np.ndarray, float]:
        """From one room to another (3,) as the eye looks now, and how many times farther it has to
        be to see both."""
        camera = self.client.camera
        R = se3.from_xyz_quat(np.zeros(3), camera.wxyz)[:3, :3]
        width, height = np.abs(R.T[:2]) @ np.diff(self._box, axis=0)[0]
        across = width / max(camera.aspect, 0.1)  # as high as this, were the picture a square
        beside, below = max(height, 2 * across), max(2 * height, across)
        shift = width * R[:, 0] if beside <= below else height * R[:, 1]
        return APART * shift, FARTHER_FOR_TWO * min(beside, below) / max(height, across)

    def _look(self, eye_and_target: Sequence[np.ndarray]) -> None:
        camera = self.client.camera
        camera.position, camera.look_at = map(np.asarray, eye_and_target)
