"""The example planner asks a running node over the bus, as its docstring says."""

import pytest

from examples.reach import main
from node.ros.bus import Bus
from node.ros.messages import QUERY_REGION
from node.ros.services import Answers
from node.ros.settings import BusConfig
from tests.node.shapes import body_with_handle, free_port


def test_a_way_that_is_free_enough_is_taken_and_a_doubtful_one_is_not(capsys: pytest.CaptureFixture) -> None:
    """The body has its handle at the left with 0.3, at the right with 0.7; the goal lies where the right one may be."""
    answers, endpoint = Answers(), f"tcp/127.0.0.1:{free_port()}"
    answers.update([body_with_handle()])
    with Bus(BusConfig(name="farside", listen=(endpoint,))) as bus:
        bus.serve("~/query_region", QUERY_REGION, answers.query_region)
        main((0.0, 0.10, 0.0), connect=endpoint)
        assert "taken: from" in capsys.readouterr().out
        main((-0.07, 0.0, 0.0), connect=endpoint)
        said = capsys.readouterr().out
        assert "free with 0.30" in said and "no way is free enough" in said
        main((-0.07, 0.0, 0.0), least=0.25, connect=endpoint)
        assert "taken: from" in capsys.readouterr().out
