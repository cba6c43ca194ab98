"""A bus that cannot start says why, and leaves nothing behind."""

import pytest
import zenoh

from node.ros.bus import Bus
from node.ros.settings import BusConfig
from tests.node.shapes import free_port


def test_a_port_in_use_is_said_in_a_line() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Bus(BusConfig(listen=(endpoint,))):
        with pytest.raises(OSError, match=f"^the bus cannot listen on {endpoint}: another program does") as caught:
            Bus(BusConfig(listen=(endpoint,))).__enter__()
    assert "\n" not in str(caught.value)


def test_a_start_that_fails_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor on the way to it: the port is free for the next try."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def fail(*_: object) -> None:
        raise zenoh.ZError("the router is gone")

    with monkeypatch.context() as broken:
        broken.setattr(Bus, "_declare", fail)
        with pytest.raises(OSError, match=r"^the bus cannot open \(the router is gone\); start the node again"):
            Bus(BusConfig(listen=(endpoint,))).__enter__()
    with Bus(BusConfig(listen=(endpoint,))) as bus:
        assert bus.graph()
