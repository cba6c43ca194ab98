"""A turntable behind a pseudo-terminal: it goes where it is sent, and every fault is one line that says what to do."""

import time
from typing import Any

import pytest
import serial

from calibration import turntable
from calibration.turntable import Turntable, TurntableConfig, TurntableError
from tests.calibration.grbl import Grbl

FAST = TurntableConfig(poll=0.01, reply_timeout=0.4, open_timeout=1.5, home_timeout=0.6, speed=1000.0)


def opened(grbl: Grbl, **more: Any) -> Turntable:
    settings = {f: getattr(FAST, f) for f in FAST.__dataclass_fields__} | more
    return Turntable(grbl.port, TurntableConfig(**settings))


def test_it_goes_where_it_is_sent_and_says_so() -> None:
    with Grbl(speed=1500.0) as grbl, opened(grbl) as table:
        for angle in (0.0, 90.0, 45.5, -30.0):
            table.move_to(angle)
            assert not grbl.moving and grbl.angle == pytest.approx(angle)
            assert table.status() == turntable.TurntableStatus("Idle", pytest.approx(angle))
        assert table.garbage == 0
        moves = [line for line in grbl.received if "G1" in line]
        assert moves[1] == "G21G90G94G1X90.0000F60000.000"


def test_units_and_sense_of_turning_are_the_tables() -> None:
    with Grbl() as grbl, opened(grbl, degrees_per_unit=-7.2) as table:
        table.move_to(36.0)
        assert grbl.angle == pytest.approx(-5.0)
        assert table.status().angle == pytest.approx(36.0)


def test_angles_are_work_coordinates() -> None:
    """Machine and work coordinates differ by an offset that is reported only now and then; `zero` moves it."""
    with Grbl(wco=100.0) as grbl, opened(grbl) as table:
        table.move_to(30.0)
        assert grbl.angle == pytest.approx(130.0)
        for _ in range(12):
            assert table.status().angle == pytest.approx(30.0)
        table.zero()
        assert table.status().angle == pytest.approx(0.0)
        table.move_to(10.0)
        assert grbl.angle == pytest.approx(140.0)


def test_homing_and_unlocking_happen_only_when_asked_for() -> None:
    with Grbl(locked=True) as grbl:
        with opened(grbl) as table:
            with pytest.raises(TurntableError, match=r"state Alarm; home it, or unlock it"):
                table.move_to(10.0)
            assert not {"$X", "$H"} & set(grbl.received)
            table.unlock()
            table.move_to(10.0)
        with opened(grbl) as table:
            table.home()
            assert table.status().angle == 0.0
            assert grbl.received.count("$H") == 1 and grbl.received.count("$X") == 1


@pytest.mark.parametrize(
    "faults",
    [
        {"boot": 0.5},
        {"stale": b"ok\r\nok\r\n<Run|MPos:7.0"},
        {"garbage": b"\xff\x00\x93"},
        {"glued": b"\xfe\x81"},
        {"garbage": b"%%@~ half a li\r\n"},
    ],
    ids=["boots", "stale answers", "noise", "noise before ok", "lines of noise"],
)
def test_what_a_serial_line_does_to_one_is_tolerated_and_counted(faults: dict) -> None:
    with Grbl(**faults) as grbl, opened(grbl) as table:
        table.move_to(90.0)
        assert grbl.angle == pytest.approx(90.0)
        if "stale" not in faults:  # opening the port flushes those, or does not
            assert (table.garbage > 0) == ("boot" not in faults)


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"silent": True}, r"nothing within 1.5 s at 115200 baud; check that it is switched on"),
        ({"only_garbage": True, "garbage": b"\xff\x80" * 9}, r"only \d+ bytes of garbage within .* and the baud rate"),
        ({"only_garbage": True, "garbage": b"\xf0" * 700}, r"only \d+ bytes of garbage within"),
        ({"hang_up_on": "G21"}, r"is gone \(.*\); check the cable"),
        ({"hang_up_moving": True, "speed": 100.0}, r"is gone \(.*\); check the cable"),
        ({"silent_after": "G21"}, r"does not answer 'G21.*; check the cable"),
        ({"alarm_on": "G21", "alarm": 2}, r"ALARM:2, Soft limit alarm\. G-code motion target exceeds machine travel"),
        ({"alarm_on": "$H", "alarm": 9}, r"ALARM:9, Homing fail\. Could not find limit switch"),
        ({"alarm_on": "G21", "alarm": 77}, "ALARM:77, see the list of alarm codes"),
        ({"refuse": "G21", "error": 20}, r"refused 'G21.*error:20, Unsupported or invalid g-code"),
        ({"refuse": "$H", "error": 5}, r"error:5, Homing cycle failure\. Homing is not enabled via settings"),
        ({"stuck": True}, r"stopped at 0\.00 degrees instead of 90\.00; check the axis letter"),
        ({"speed": 5.0}, r"still says Run at \d+\.\d+ degrees after 1\.0 s"),
    ],
)
def test_a_fault_is_one_line_and_never_a_hang(faults: dict, said: str) -> None:
    begun = time.monotonic()
    with Grbl(**faults) as grbl, pytest.raises(TurntableError, match=said) as caught:
        with opened(grbl) as table:
            if "$H" in (faults.get("alarm_on"), faults.get("refuse")):
                table.home()
            table.move_to(90.0)
    assert "\n" not in str(caught.value) and grbl.port in str(caught.value)
    assert time.monotonic() - begun < 10.0


def test_an_error_of_ours_stops_the_table() -> None:
    with Grbl() as grbl:
        with pytest.raises(KeyError), opened(grbl) as table:
            {"": 0}[table.port]
        deadline = time.monotonic() + 2.0
        while not grbl.holds and time.monotonic() < deadline:
            time.sleep(0.01)
        assert grbl.holds == 1


def test_a_port_that_cannot_be_had_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Port:
        device, description = "/dev/ttyACM7", "USB Serial"

    monkeypatch.setattr(turntable.list_ports, "comports", lambda: [Port()])
    with pytest.raises(ValueError, match=r"no serial port was named; there are /dev/ttyACM7 \(USB Serial\)"):
        Turntable(None)
    with pytest.raises(TurntableError, match=r"/dev/ttyNOT: no such serial port; there are /dev/ttyACM7"):
        Turntable("/dev/ttyNOT").__enter__()
    monkeypatch.setattr(turntable.list_ports, "comports", list)
    with pytest.raises(ValueError, match="none was found: plug the turntable in"):
        Turntable("")
    with pytest.raises(TurntableError, match=r"cannot be opened .*give a serial port"):
        Turntable("/dev/null").__enter__()
    with Grbl() as grbl, serial.Serial(grbl.port, exclusive=True), pytest.raises(TurntableError, match="is busy"):
        opened(grbl).__enter__()


def test_a_config_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="degrees_per_unit is 0"):
        TurntableConfig(degrees_per_unit=0.0)
    with pytest.raises(ValueError, match="poll is -1"):
        TurntableConfig(poll=-1.0)
    with Grbl() as grbl, pytest.raises(TurntableError, match="reports 3 axes, none is A; give one of X, Y, Z"):
        opened(grbl, axis="A").__enter__()
