"""The time of the node: the machine's, or that of a simulation or of a recording that is played."""

import time
from typing import Any

from node.ros.bus import Bus

CLOCK = "rosgraph_msgs/msg/Clock"


class Clock:
    """Now, as ROS 2 nodes tell it. With `simulated` (`use_sim_time`) it is the newest time on /clock; until the first
    one comes it is the machine's.
    """

    def __init__(self, bus: Bus | None = None, simulated: bool = False) -> None:
        self._newest: int | None = None
        if bus is not None and simulated:
            bus.subscribe("/clock", CLOCK, self._take, depth=1)

    def now_ns(self) -> int:
        """Nanoseconds since the epoch, or since the simulation's."""
        return time.time_ns() if self._newest is None else self._newest

    def _take(self, message: Any) -> None:
        self._newest = message.clock.sec * 1_000_000_000 + message.clock.nanosec
