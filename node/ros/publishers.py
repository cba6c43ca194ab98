"""The topics that the node publishes for each scene, for planners, people and ROS 2 tools."""

from collections.abc import Callable, Sequence

from calibration.camera import Camera
from node.ros.bus import Bus, Publisher
from node.ros.clock import Clock
from node.ros.messages import HYPOTHESES, frame_messages, hypotheses_message
from node.ros.planner_messages import (
    DETECTIONS,
    OCTOMAP,
    PLANNING_SCENE,
    SceneDifferences,
    detections_message,
    octomap_message,
)
from node.ros.scene_messages import (
    DiagnosticStatus,
    counts_status,
    diagnostics_message,
    markers_message,
    occupancy_message,
    sampler_status,
    transforms_message,
    uncertainty_message,
)
from node.ros.settings import PlannerConfig
from perception.answers.hypotheses import Hypotheses
from perception.sources.frame import Frame

_CAMERA = {"color/image_raw": "Image", "color/camera_info": "CameraInfo", "depth/image_raw": "Image"}


class Announcer:
    """Publishes ~/hypotheses (latched), ~/occupancy, ~/markers, ~/uncertainty, /diagnostics, /tf, for planners
    ~/planning_scene, ~/octomap and ~/detections, and the camera's ~/color/image_raw, ~/color/camera_info and
    ~/depth/image_raw. A topic without subscribers is not computed.
    """

    def __init__(self, bus: Bus, planner: PlannerConfig | None = None, clock: Clock | None = None) -> None:
        self._bus, self._planner, self._clock = bus, planner or PlannerConfig(), clock or Clock()
        self._node = bus.node.resolve("~/object").removesuffix("/object")
        # One of each object: a late subscriber gets the last answer of each that is there, and no earlier one.
        self._hypotheses: dict[int, Publisher] = {}
        self._occupancy = bus.publisher("~/occupancy", "sensor_msgs/msg/PointCloud2")
        self._markers = bus.publisher("~/markers", "visualization_msgs/msg/MarkerArray")
        self._uncertainty = bus.publisher("~/uncertainty", "sensor_msgs/msg/Image")
        self._diagnostics = bus.publisher("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._planning_scene = bus.publisher(self._planner.scene, PLANNING_SCENE, depth=10)
        self._octomap = bus.publisher("~/octomap", OCTOMAP)
        self._detections = bus.publisher("~/detections", DETECTIONS)
        self._differences = SceneDifferences(self._node, self._planner)
        images = {name: f"sensor_msgs/msg/{kind}" for name, kind in _CAMERA.items()}
        self._camera = {name: bus.publisher(f"~/{name}", kind) for name, kind in images.items()}
        self._tf = bus.publisher("/tf", "tf2_msgs/msg/TFMessage", depth=100)

    @property
    def node(self) -> str:
        """The node's full name, such as /farside. The names of its objects' frames begin with it."""
        return self._node

    def frame(self, frame: Frame) -> None:
        """Publish what the camera saw, as a driver would."""
        if any(publisher.wanted for publisher in self._camera.values()):
            for name, message in frame_messages(frame).items():
                self._camera[name].publish(message)

    def scene(self, objects: Sequence[Hypotheses], camera: Camera, method: str = "") -> None:
        """Publish everything about one scene. `camera` is that of the picture."""
        for gone in self._hypotheses.keys() - {h.object_id for h in objects}:
            self._hypotheses.pop(gone).close()
        for h in objects:
            if h.object_id not in self._hypotheses:
                self._hypotheses[h.object_id] = self._bus.publisher("~/hypotheses", HYPOTHESES, latched=True)
            self._hypotheses[h.object_id].publish(hypotheses_message(h, method))
        self._plan(objects)
        if not objects:
            return
        self._tf.publish(transforms_message(objects, self._node))
        views: list[tuple[Publisher, Callable[[], object]]] = [
            (self._occupancy, lambda: occupancy_message(objects)),
            (self._markers, lambda: markers_message(objects)),
            (self._uncertainty, lambda: uncertainty_message(objects, camera)),
            (self._octomap, lambda: octomap_message(objects, self._node, self._planner.octomap_m)),
            (self._detections, lambda: detections_message(objects)),
        ]
        for publisher, build in views:
            if publisher.wanted:
                publisher.publish(build())

    def _plan(self, objects: Sequence[Hypotheses]) -> None:
        """Publish the planning scene's difference to the one that was published last; also to say that all is gone."""
        if self._planning_scene.wanted and (message := self._differences.message(objects)) is not None:
            if self._planning_scene.publish(message):
                self._differences.sent()

    def status(self, objects: Sequence[Hypotheses], others: Sequence[DiagnosticStatus] = ()) -> None:
        """Publish /diagnostics: the sampler's state for each object, the bus's counts, and `others` (camera, rates)."""
        now = self._clock.now_ns()
        statuses = [*others, *(sampler_status(h, now) for h in objects), counts_status(self._bus.counts.all())]
        self._diagnostics.publish(diagnostics_message(now, statuses))
