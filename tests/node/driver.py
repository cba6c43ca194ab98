"""A camera driver as another process: plays a recording's frames round and round as ROS 2 camera topics."""

import sys
import time
from dataclasses import replace
from pathlib import Path

from node.ros.bus import Bus
from node.ros.messages import frame_messages
from node.ros.settings import BusConfig, TopicConfig
from perception.sources.recording import Log


def play(endpoint: str, path: Path, rate: float) -> None:
    """Until standard input ends."""
    names = TopicConfig()
    frames = list(Log(path))
    with Bus(BusConfig(name="driver", listen=("tcp/127.0.0.1:0",), connect=(endpoint,))) as bus:
        topics = {
            "color/image_raw": bus.publisher(names.colour, "sensor_msgs/msg/Image", depth=3),
            "color/camera_info": bus.publisher(names.info, "sensor_msgs/msg/CameraInfo", depth=3),
            "depth/image_raw": bus.publisher(names.depth, "sensor_msgs/msg/Image", depth=3),
        }
        print("ready", flush=True)
        while True:
            for frame in frames:
                messages = frame_messages(replace(frame, stamp_ns=time.time_ns()))
                for name in ("color/camera_info", "depth/image_raw", "color/image_raw"):
                    topics[name].publish(messages[name])
                time.sleep(1.0 / rate)


if __name__ == "__main__":
    play(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]))
