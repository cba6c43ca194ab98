"""The page: a scene in 3D in a browser on this machine, with a box for queries.

Everything is served from and to 127.0.0.1, to the page alone (`page_guard`). `show` may be called from any thread, as
viser calls back from its own.
"""

import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from viser.transforms import SO3

from node.figures import voxel_renderer
from node.viewer import panel, scene3d
from node.viewer.page_guard import GuardedServer
from node.viewer.scene3d import CameraView, PageScene
from perception.answers.hypotheses import Hypotheses
from probnerf.types import BASE_Z

NEXT_VIEWS = 5  # shown


class Page:
    """A page on 127.0.0.1 that shows one scene at a time. Close it, or use it in a `with`."""

    def __init__(self, port: int = 8765, token: bool = False) -> None:
        """Open the page. Port 0 takes a free one; with `token` only those who know the address can open it.

        Raises OSError or ValueError if `port` cannot be used.
        """
        self._server = GuardedServer(port, token)
        self._lock = threading.RLock()  # held while the scene is read or replaced
        self._placed: PageScene | None = None
        self._view: CameraView | None = None
        self._cloud: scene3d.Cloud | None = None
        self._ranks: dict[int, int] = {}  # object id: which hypothesis is shown, 0 the heaviest
        self._asked: tuple[float, ...] = ()  # the box of the answer that is shown
        self._shown = 0  # scenes so far
        self._layers: dict[str, viser.FrameHandle] = {}
        self._build_left()
        self._build_right()
        self._build_box()

    @property
    def address(self) -> str:
        """The page's URL."""
        return self._server.address

    def show(self, scene: Sequence[Hypotheses], view: CameraView | None = None) -> None:
        """Replace the scene. After the first scene the box and all switches stay as they are.

        Raises ValueError if the scene has no objects, or objects of different frames.
        """
        placed = scene3d.place(scene)
        unseen = scene3d.cloud(placed)
        with self._lock:
            first, self._shown = self._shown == 0, self._shown + 1
            self._placed, self._view, self._cloud = placed, view, unseen
            with self._server.atomic():
                self._state.content = panel.state(scene)
                names = [str(h.object_id) for h in placed.objects]
                chosen = self._object.value
                self._object.options = names
                self._object.value = chosen if chosen in names else names[0]
                self._object.visible = len(names) > 1
                self._draw_camera()
                self._draw_plane()
                self._draw_shapes()
                self._draw_cloud()
                if first:
                    self._place_box()
                    self._look(placed)
            self._asked = ()
            self._answer()
        threading.Thread(target=self._rank_views, args=(list(scene), placed, self._shown), daemon=True).start()

    def close(self) -> None:
        """End the page."""
        with self._lock:
            self._shown += 1  # next views that are still being found are not drawn
        self._server.stop()

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _build_left(self) -> None:
        """The camera's picture, and what makes the scene doubtful."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(30, 90, 150))
        gui.set_panel_label("Farside")
        self._server.scene.configure_default_lights(cast_shadow=False)  # shadows are slow without a graphics card
        window = gui.add_panel()
        with window.add_tab("The view"):
            self._picture = gui.add_image(np.full((3, 4, 3), 240, np.uint8))
            self._tinted = gui.add_checkbox("pixel statuses", True)
            self._statuses = gui.add_html(panel.statuses())
            self._state = gui.add_html("")
        window.dock_left()
        window.set_width(310)

    def _build_right(self) -> None:
        """Controls: the box's answer and sizes, the hypotheses, the unseen space, next views, and the layers."""
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)
        with gui.add_folder("Is this box free? Drag its arrows"):
            self._words = gui.add_html("")
            self._sides: list[Any] = [gui.add_slider(f"{a} side (mm)", 2, 300, 1, 40) for a in "xyz"]
            self._again = gui.add_button("put it where shapes disagree")
        with gui.add_folder("Hypotheses, heaviest first"):
            self._object: Any = gui.add_dropdown("object", ("-",))
            self._which = gui.add_html("")
            self._rank: Any = gui.add_slider("number", 1, 2, 1, 1)
            self._step = gui.add_button_group("step", ("previous", "next"))
            gui.add_html(panel.surfaces())
        with gui.add_folder("Unseen space"):
            self._mode = gui.add_dropdown("colours", tuple(panel.SCALES))
            self._least = gui.add_slider("show above", 0.02, 0.98, 0.02, 0.3)
            self._scale = gui.add_html("")
        self._next = gui.add_folder("Where to look next", visible=False)
        with self._next:
            self._gains = gui.add_html("")
        with gui.add_folder("Show", expand_by_default=False):
            for name, node in panel.LAYERS.items():
                self._layers[node] = self._server.scene.add_frame(node, show_axes=False)
                gui.add_checkbox(name, True).on_update(lambda event: self._hide(event.target))
        controls: list[tuple[Any, list[Callable[[], None]]]] = [
            (self._tinted, [self._draw_camera]),
            (self._object, [self._draw_shapes, self._draw_camera]),
            (self._rank, [self._turn_to]),
            (self._mode, [self._draw_cloud]),
            (self._least, [self._draw_cloud]),
            *((side, [self._answer]) for side in self._sides),
        ]
        for handle, draw in controls:
            handle.on_update(lambda event, draw=draw: self._redraw(*draw) if event.client_id is not None else None)
        self._step.on_click(lambda _: self._redraw(self._turn))
        self._again.on_click(lambda _: self._redraw(self._place_box, self._answer))

    def _build_box(self) -> None:
        """The box in question: arrows to drag, its body, and its answer beside it."""
        scene = self._server.scene
        self._gizmo = scene.add_transform_controls("/ask/box", scale=0.06, disable_rotations=True, depth_test=False)
        quiet: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        self._body = scene.add_box("/ask/box/body", opacity=0.4, **quiet)
        self._edges = scene.add_line_segments(
            "/ask/box/edges", scene3d.BOX_EDGES, (0, 0, 0), thickness=2.0, thickness_units="screen"
        )
        self._odds = scene.add_label("/ask/box/odds", "", anchor="bottom-center", font_screen_scale=1.3)
        self._gizmo.on_update(lambda _: self._answer())

    def _hide(self, switch: Any) -> None:
        self._layers[panel.LAYERS[switch.label]].visible = switch.value

    def _put(self, node: str, T_page_node: Float[np.ndarray, "4 4"]) -> None:
        self._layers[node].wxyz = SO3.from_matrix(T_page_node[:3, :3]).wxyz
        self._layers[node].position = T_page_node[:3, 3]

    def _redraw(self, *draw: Callable[[], None]) -> None:
        """Run a control's drawing steps, if there is a scene yet."""
        with self._lock:
            if self._placed is not None:
                with self._server.atomic():
                    for step in draw:
                        step()

    def _answer(self) -> None:
        """Query the box where it is now. A call that waited for another finds its box already answered."""
        with self._lock:
            centre, size = np.array(self._gizmo.position), 1e-3 * np.array([side.value for side in self._sides])
            if self._placed is None or (*centre, *size) == self._asked:
                return
            self._asked = (*centre, *size)
            self._body.dimensions = self._edges.scale = tuple(size)
            self._odds.position = (0.0, 0.0, max(0.5 * size[2], self._gizmo.scale))
            result = scene3d.ask(self._placed, centre, size)
            with self._server.atomic():
                self._words.content = panel.answer(result, centre, size, self._placed.title)
                self._odds.text = panel.odds(result)
                self._body.color = panel.rgb(panel.paint(result))

    def _place_box(self) -> None:
        assert self._placed is not None and self._cloud is not None
        centre, size = scene3d.first_box(self._placed, self._cloud)
        self._gizmo.position = tuple(centre)
        for side, metres in zip(self._sides, size, strict=True):
            side.value = round(1e3 * float(metres))

    def _look(self, placed: PageScene) -> None:
        """Move the viewpoint to where both sides of the objects are visible."""
        position, at = scene3d.onlooker(placed)
        self._server.scene.set_up_direction(placed.up)
        cameras: list[Any] = [self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())]
        for camera in cameras:
            camera.position, camera.look_at = position, at

    def _draw_camera(self) -> None:
        """The picture, the camera that took it, and the points that it measured."""
        assert self._placed is not None
        scene, view = self._server.scene, self._view
        self._picture.visible = self._tinted.visible = self._statuses.visible = view is not None
        if view is None:
            for node in ("/camera/frustum", "/camera/name", "/seen/points"):
                scene.remove_by_name(node)
            return
        self._picture.image = scene3d.picture(view, int(self._object.value), self._tinted.value)
        fov, aspect = scene3d.field_of_view(view.frame)
        self._put("/camera", self._placed.T_page_camera)
        small, scale = view.frame.rgb[::2, ::2], 0.14 * self._placed.distance
        scene.add_camera_frustum("/camera/frustum", fov, aspect, scale=scale, thickness=0.002, image=small)
        scene.add_label("/camera/name", "camera", anchor="bottom-center")
        points, colours = scene3d.seen_surface(self._placed, view)
        if len(points):
            scene.add_point_cloud("/seen/points", points, colours, point_size=0.002, precision="float32")
        else:
            scene.remove_by_name("/seen/points")

    def _draw_plane(self) -> None:
        assert self._placed is not None
        h = self._placed.objects[0]
        half = h.object_frame.half_extent
        self._put("/plane", self._placed.T_page_object(h))
        side = 2.0 * scene3d.AROUND * half
        under = (0.0, 0.0, BASE_Z * half)
        self._server.scene.add_grid("/plane/grid", side, side, cell_size=0.01, section_size=0.05, position=under)

    def _draw_shapes(self) -> None:
        """Every object's chosen hypothesis, and the controls of the object that is stepped through."""
        assert self._placed is not None
        scene = self._server.scene
        ids = {h.object_id for h in self._placed.objects}
        for gone in set(self._ranks) - ids:
            scene.remove_by_name(f"/shapes/{gone}")
            del self._ranks[gone]
        for h in self._placed.objects:
            order, weights = scene3d.weights_in_order(h)
            rank = self._ranks[h.object_id] = min(self._ranks.get(h.object_id, 0), len(order) - 1)
            found = scene3d.shape(self._placed, h, int(order[rank]))
            for part, faces, paint, opacity in (
                ("seen", found.seen, voxel_renderer.SEEN, None),
                ("unseen", found.unseen, voxel_renderer.UNSEEN, 0.6),  # what may be inside shows through
            ):
                name = f"/shapes/{h.object_id}/{part}"
                if len(faces):
                    scene.add_mesh_simple(name, found.vertices, faces, color=tuple(paint), opacity=opacity)
                else:
                    scene.remove_by_name(name)
            if str(h.object_id) == self._object.value:
                self._rank.max, self._rank.disabled = max(len(order), 2), len(order) == 1
                self._rank.value = rank + 1
                self._which.content = panel.box(panel.hypothesis(rank + 1, len(order), weights[rank]), "15px")

    def _turn_to(self) -> None:
        if self._ranks[int(self._object.value)] != self._rank.value - 1:
            self._ranks[int(self._object.value)] = self._rank.value - 1
            self._draw_shapes()

    def _turn(self) -> None:
        step = 1 if self._step.value == "next" else -1
        self._rank.value = min(max(self._rank.value + step, 1), self._rank.max)
        self._turn_to()

    def _draw_cloud(self) -> None:
        """Unseen space above the threshold, in the chosen colours, and what the colours mean."""
        assert self._cloud is not None
        ramp, words = panel.SCALES[self._mode.value]
        values = self._cloud.p_occupied if ramp is panel.OCCUPIED else self._cloud.disagreement
        keep = values >= self._least.value
        self._server.scene.add_point_cloud(
            "/unseen/cloud",
            self._cloud.points[keep],
            scene3d.colours(values[keep], ramp),
            point_size=0.2 * self._cloud.voxel_m,
            point_shape="circle",
            precision="float32",
        )
        self._scale.content = panel.scale(ramp, *words)

    def _rank_views(self, scene: list[Hypotheses], placed: PageScene, shown: int) -> None:
        """Suggested next views, found in the background: it takes longer than to show the rest."""
        from perception.answers.next_view import rank_views

        ranked = rank_views(scene, None, NEXT_VIEWS)
        with self._lock:
            if shown != self._shown:  # another scene is shown by now
                return
            with self._server.atomic():
                self._put("/next", placed.T_page_object(placed.objects[0]))
                self._next.visible, self._gains.content = (
                    True,
                    panel.views(ranked.gain_nats.tolist(), ranked.entropy_nats),
                )
                paint = scene3d.colours(ranked.gain_nats / max(ranked.gain_nats.max(), 1e-9), panel.GAIN)
                for i, (T, colour) in enumerate(zip(ranked.T_object_camera, paint, strict=True), start=1):
                    self._draw_next(f"/next/{i}", T, colour, str(i))

    def _draw_next(self, node: str, T: Float[np.ndarray, "4 4"], colour: np.ndarray, text: str) -> None:
        """A camera to look from and, near the object, for the camera itself may be far off, its direction."""
        scene, reach = self._server.scene, float(np.linalg.norm(T[:3, 3]))
        pose: dict[str, Any] = {"wxyz": SO3.from_matrix(T[:3, :3]).wxyz, "position": T[:3, 3]}
        scene.add_camera_frustum(node, 0.7, 1.33, scale=0.1 * reach, thickness=0.0015, color=colour, **pose)
        ends = np.array([[[0.0, 0.0, 0.73 * reach], [0.0, 0.0, 0.81 * reach]]])
        scene.add_arrows(f"{node}/arrow", ends, colour, shaft_radius=0.001, head_radius=0.003, head_length=0.009)
        scene.add_label(f"{node}/rank", text, position=(0.0, 0.0, 0.72 * reach), anchor="bottom-center")
