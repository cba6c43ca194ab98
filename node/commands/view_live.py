"""`farside view --live`: the page of a node that runs elsewhere, from its messages on the bus."""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any

from rich.console import Console

from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, hypotheses_from
from node.ros.settings import BusConfig, TopicConfig
from node.ros.topic_source import TopicSource
from node.viewer.scene3d import CameraView, camera_view
from perception.answers.hypotheses import Hypotheses
from perception.sources.frame import Frame

FRAMES = 300  # kept until their hypotheses arrive


def watch(endpoint: str, node: str, port: int, token: bool, out: Console, err: Console) -> None:
    """Show what the node `node` (such as /farside) at `endpoint` publishes, until Ctrl-C; `token` as `Page`.

    Raises ValueError or OSError in one line: no endpoint, no answer, or a port that is in use.
    """
    from node.viewer.page import Page  # viser takes a second to import

    def say(text: str) -> None:
        err.print(text, highlight=False, soft_wrap=True)

    config = BusConfig(name="farside_view", connect=(endpoint,))
    with Bus(config, say) as bus, Page(port, token) as page:
        source = TopicSource(bus, camera_topics(node))
        shown = Shown()
        threading.Thread(target=shown.keep, args=(source,), daemon=True).start()
        arrival = threading.Event()

        def take(message: Any) -> None:
            scene = shown.take(hypotheses_from(message))
            page.show(scene, shown.view())
            arrival.set()

        bus.subscribe(f"{node}/hypotheses", HYPOTHESES, take, depth=10)
        out.print(f"{page.address} shows {node} at {endpoint}; Ctrl-C ends it", highlight=False, soft_wrap=True)
        try:
            if not arrival.wait(10.0):
                say(f"nothing from {node} at {endpoint} yet; is it running, and has it seen an object?")
            threading.Event().wait()
        except KeyboardInterrupt:
            pass
        finally:
            source.close()


def camera_topics(node: str) -> TopicConfig:
    """The topics on which a node publishes what its camera saw."""
    names = (f"{node}/color/image_raw", f"{node}/depth/image_raw", f"{node}/color/camera_info")
    return TopicConfig(*names)


class Shown:
    """The objects of the newest scene, and recent frames whose hypotheses may still arrive."""

    def __init__(self) -> None:
        self._scene: dict[int, Hypotheses] = {}
        self._frames: OrderedDict[int, Frame] = OrderedDict()

    def keep(self, source: Iterable[Frame]) -> None:
        """Take frames until the source ends."""
        for frame in source:
            self._frames[frame.stamp_ns] = frame
            while len(self._frames) > FRAMES:
                self._frames.popitem(last=False)

    def view(self) -> CameraView | None:
        """The scene's frame and the pixels of its objects, if the frame came."""
        scene = list(self._scene.values())
        frame = self._frames.get(scene[0].stamp_ns) if scene else None
        return None if frame is None or frame.frame_id != scene[0].frame_id else camera_view(frame, scene)

    def take(self, h: Hypotheses) -> list[Hypotheses]:
        """The scene with one object's new hypotheses: all objects of that frame."""
        others = {name: o for name, o in self._scene.items() if (o.stamp_ns, o.frame_id) == (h.stamp_ns, h.frame_id)}
        self._scene = others | {h.object_id: h}
        return list(self._scene.values())
