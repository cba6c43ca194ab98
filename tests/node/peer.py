"""Another process on the bus, for the tests: `python -m tests.node.peer PORT`; ends when its standard input does."""

import sys
import threading
import time
from typing import Any

import zenoh

from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, hypotheses_message, make, register_service, type_hash
from node.ros.rmw_zenoh import key
from node.ros.settings import BusConfig
from tests.node.shapes import body_with_handle

ADD, ADD_TEXT = "example_interfaces/srv/AddTwoInts", "int64 a\nint64 b\n---\nint64 sum\n"
SET, SET_TEXT = "std_srvs/srv/SetBool", "bool data\n---\nbool success\nstring message\n"
TEXT, IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Image"


def refuse(request: Any) -> Any:
    raise ValueError("there are no hypotheses yet; ask again later")


def stuck(port: int, done: threading.Event) -> None:
    """A subscriber that takes one image and no more, so that the sender's connection to it fills up."""
    config = BusConfig(name="stuck", connect=(f"tcp/127.0.0.1:{port}",)).settings()
    with zenoh.open(zenoh.Config.from_json5(str(config).replace("True", "true").replace("False", "false"))) as session:
        where = key(0, "/stuck", IMAGE, type_hash(IMAGE))
        subscriber = session.declare_subscriber(where, zenoh.handlers.FifoChannel(1))
        done.wait()
        while subscriber.try_recv() is not None:
            time.sleep(0)


def main() -> None:
    port = int(sys.argv[1])
    register_service(ADD, ADD_TEXT)
    register_service(SET, SET_TEXT)
    with Bus(BusConfig(name="peer", connect=(f"tcp/127.0.0.1:{port}",))) as bus:
        latched = bus.publisher("~/hypotheses", HYPOTHESES, latched=True)
        for stage in (1, 2, 3):
            latched.publish(hypotheses_message(body_with_handle(stage=stage)))
        echo = bus.publisher("~/echo", IMAGE)
        bus.subscribe("/image", IMAGE, echo.publish)
        bus.serve("/add", ADD, lambda r: make(f"{ADD}_Response", sum=r.a + r.b))
        bus.serve("/refuse", SET, refuse)
        done = threading.Event()
        thread = threading.Thread(target=stuck, args=(port, done), daemon=True)
        thread.start()
        print("ready", flush=True)
        sys.stdin.read()
        done.set()
        thread.join()


if __name__ == "__main__":
    main()
