"""A turntable on a serial line, driven with G-code as grbl 1.1 understands it: one command, one answer.

grbl answers each line with `ok` or `error:N`; `?` is answered at once with a report such as `<Idle|MPos:90.000,0,0>`.
A G-code line is answered when it is queued, not when the motion is over. The end of the motion is found by polling
until the state is Idle at the commanded angle.
"""

import itertools
import re
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

import serial
from serial.tools import list_ports

from foundation.one_line import one_line

# grbl's texts (doc/csv of grbl 1.1) for errors of a turntable; others are reported by number.
ERRORS = {
    1: "G-code words consist of a letter and a value. Letter was not found.",
    2: "Missing the expected G-code word value or numeric value format is not valid.",
    3: "Grbl '$' system command was not recognized or supported.",
    5: "Homing cycle failure. Homing is not enabled via settings.",
    8: "Grbl '$' command cannot be used unless Grbl is IDLE. Ensures smooth operation during a job.",
    9: "G-code commands are locked out during alarm or jog state.",
    11: "Max characters per line exceeded. Received command line was not executed.",
    13: "Safety door detected as opened and door state initiated.",
    20: "Unsupported or invalid g-code command found in block.",
    22: "Feed rate has not yet been set or is undefined.",
    33: "Motion command target is invalid.",
}
ALARMS = {
    1: "Hard limit has been triggered. Machine position is likely lost due to sudden halt. Re-homing is highly"
    " recommended.",
    2: "Soft limit alarm. G-code motion target exceeds machine travel. Machine position retained. Alarm may be safely"
    " unlocked.",
    3: "Reset while in motion. Machine position is likely lost due to sudden halt. Re-homing is highly recommended.",
    6: "Homing fail. The active homing cycle was reset.",
    7: "Homing fail. Safety door was opened during homing cycle.",
    8: "Homing fail. Pull off travel failed to clear limit switch. Try increasing pull-off setting or check wiring.",
    9: "Homing fail. Could not find limit switch within search distances. Try increasing max travel, decreasing"
    " pull-off distance, or check wiring.",
}
_AXES = "XYZABC"  # grbl's order in reports
_LONGEST = 1024  # bytes: a line of grbl's is far shorter, so that more without an end of line is garbage
_KNOWN = re.compile(r"ok$|error:\d+$|ALARM:\d+$|<[^<>]*>$|\[.*\]$|Grbl |\$\w+=|>")
_QUIET_S = 0.1  # silence that ends the answers to earlier bytes
_STILL = 5  # reports of a standing table at another angle before that is an error


class TurntableError(OSError):
    """The turntable, or the line to it, failed: one line with the port, what was seen, and the remedy."""


@dataclass(frozen=True)
class TurntableConfig:
    """How the table hangs on its controller, and how long to wait for it."""

    axis: Literal["X", "Y", "Z", "A", "B", "C"] = "X"
    """Letter of the axis that turns the table."""
    degrees_per_unit: float = 1.0
    """Degrees that the table turns for one G-code unit; negative turns the other way."""
    speed: float = 30.0
    """Degrees per second."""
    tolerance: float = 0.5
    """Largest difference, degrees, between commanded and reported angle that counts as arrived."""
    baud: int = 115_200
    """Bits per second of the serial line."""
    open_timeout: float = 8.0
    """Seconds for the controller to answer after the port was opened (an Arduino boots for two)."""
    reply_timeout: float = 3.0
    """Seconds for the answer to a command or to `?`."""
    home_timeout: float = 90.0
    """Seconds for homing."""
    poll: float = 0.1
    """Seconds between reports while the table turns."""

    def __post_init__(self) -> None:
        if self.degrees_per_unit == 0 or not abs(self.degrees_per_unit) < float("inf"):
            raise ValueError(f"degrees_per_unit is {self.degrees_per_unit}; give degrees per G-code unit, such as 1.0")
        for name in ("speed", "tolerance", "baud", "open_timeout", "reply_timeout", "home_timeout", "poll"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"turntable {name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True)
class TurntableStatus:
    """One report of the controller."""

    state: str  # Idle, Run, Hold, Jog, Alarm, Door, Check, Home or Sleep
    angle: float  # degrees, in work coordinates


def ports() -> list[str]:
    """Serial ports of this machine, each with a description of its device."""
    return [f"{port.device} ({port.description})" for port in sorted(list_ports.comports())]


class Turntable:
    """An open turntable: `with Turntable("/dev/ttyUSB0") as table: table.move_to(90.0)`.

    Every method raises TurntableError where the line or the controller fails; none waits without limit. `garbage`
    counts received bytes that are not an answer of grbl. A few are tolerated; many indicate a wrong baud rate.
    """

    def __init__(self, port: str | None, config: TurntableConfig | None = None):
        self.config = config or TurntableConfig()
        if not port:
            found = ports()
            there = f"there are {', '.join(found)}" if found else "none was found: plug the turntable in"
            raise ValueError(f"no serial port was named; {there}")
        self.port = port
        self.garbage = 0
        self._line: serial.Serial | None = None
        self._received = bytearray()
        self._offset: list[float] = []  # WCO: machine minus work coordinates, reported now and then

    def __enter__(self) -> Self:
        try:
            self._line = serial.Serial(
                self.port, self.config.baud, timeout=0.05, write_timeout=self.config.reply_timeout, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise TurntableError(self._not_opened(error)) from None
        try:
            self._resynchronise()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the motion if an error ended the block, and close the port."""
        if kind is not None and self._line is not None:
            try:
                self._line.write(b"!")  # feed hold: a table that nobody watches must not go on turning
            except (serial.SerialException, OSError):
                pass
        self.close()

    def close(self) -> None:
        """Release the port."""
        if self._line is not None:
            try:
                self._line.close()
            except (serial.SerialException, OSError):  # the cable is unplugged
                pass
        self._line = None

    def status(self) -> TurntableStatus:
        """The controller's state and the table's present angle."""
        deadline = time.monotonic() + self.config.reply_timeout
        while True:
            self._write(b"?")
            again = min(deadline, time.monotonic() + max(self.config.poll, 0.25))  # a report may be lost to noise
            while (line := self._read_line(again)) is not None:
                self._alarm(line)
                if line.startswith("<") and (status := self._report(line)) is not None:
                    return status
            if time.monotonic() >= deadline:
                raise self._silent("a report (`?`)")

    def home(self) -> None:
        """Turn to the limit switch (`$H`), which defines the angle."""
        self._command("$H", self.config.home_timeout)
        self._wait_idle(None, self.config.home_timeout)

    def unlock(self) -> None:
        """Clear an alarm (`$X`) without homing: only a person who looks at the table can know that this is safe."""
        self._command("$X", self.config.reply_timeout)

    def zero(self) -> None:
        """Define the present angle as 0."""
        self._command(f"G92{self.config.axis}0", self.config.reply_timeout)

    def move_to(self, angle: float) -> None:
        """Turn to `angle` (degrees) and return when the table has stopped there."""
        if not abs(angle) < 1e6:
            raise ValueError(f"the angle is {angle} degrees; give a finite one")
        config = self.config
        before = self.status()
        self._refuse_unready(before.state)
        unit, feed = angle / config.degrees_per_unit, 60.0 * config.speed / abs(config.degrees_per_unit)
        self._command(f"G21G90G94G1{config.axis}{unit:.4f}F{feed:.3f}", config.reply_timeout)
        self._wait_idle(angle, 2.0 * abs(angle - before.angle) / config.speed + 2.0 * config.reply_timeout)

    # -------------------------------------------------------------------------------------------- conversation

    def _resynchronise(self) -> None:
        """Bring the controller from any state to one that answers: a newline first, then a soft reset."""
        deadline = time.monotonic() + self.config.open_timeout
        for ask in itertools.cycle((b"\r\n", b"\r\n", b"\x18")):  # a controller that still boots loses the first ones
            if time.monotonic() >= deadline:
                break
            self._write(ask)
            patience = min(deadline, time.monotonic() + min(1.5, 0.2 * self.config.open_timeout))
            while (line := self._read_line(patience)) is not None:
                if line == "ok" or line.startswith("Grbl "):
                    while self._read_line(time.monotonic() + _QUIET_S) is not None:  # answers to earlier bytes
                        pass
                    self.status()
                    return
        noise = self.garbage + len(self._received)
        seen = f"{f'only {noise} bytes of garbage' if noise else 'nothing'} within {self.config.open_timeout:g} s"
        remedy = "check that it is switched on, that it runs grbl 1.1, and the baud rate"
        raise TurntableError(f"turntable on {self.port}: {seen} at {self.config.baud} baud; {remedy}")

    def _command(self, text: str, timeout: float) -> None:
        """Send one line and wait for its `ok`."""
        self._write(text.encode("ascii") + b"\n")
        deadline = time.monotonic() + timeout
        while (line := self._read_line(deadline)) is not None:
            self._alarm(line)
            if line == "ok":
                return
            if line.startswith("error:"):
                number = int(line[6:])
                words = f"error:{number}, {ERRORS.get(number, 'see the list of error codes of grbl')}"
                raise TurntableError(f"turntable on {self.port} refused {text!r}: {words}")
            if line.startswith("Grbl "):
                raise TurntableError(f"turntable on {self.port} was reset during {text!r}; check its power")
        raise self._silent(repr(text))

    def _wait_idle(self, angle: float | None, timeout: float) -> None:
        """Poll until the table has stopped, at `angle` if given (right after `ok` the motion may not have begun)."""
        deadline, still = time.monotonic() + timeout, 0
        while True:
            status = self.status()
            if status.state == "Idle":
                if angle is None or abs(status.angle - angle) <= self.config.tolerance:
                    return
                still += 1
                if still >= _STILL:
                    raise TurntableError(
                        f"turntable on {self.port} stopped at {status.angle:.2f} degrees instead of {angle:.2f};"
                        " check the axis letter, degrees_per_unit and the motor"
                    )
            else:
                self._refuse_unready(status.state)
                still = 0
            if time.monotonic() > deadline:
                where = f"still says {status.state} at {status.angle:.2f} degrees after {timeout:.1f} s"
                raise TurntableError(f"turntable on {self.port} {where}; check its speed, or give a slower one")
            time.sleep(self.config.poll)

    def _refuse_unready(self, state: str) -> None:
        if state not in ("Idle", "Run", "Jog", "Home"):
            remedy = {
                "Alarm": "home it, or unlock it ($X) once you have seen that nothing is jammed",
                "Hold": "release the hold",
                "Door": "close its door",
                "Sleep": "reset it",
                "Check": "leave check mode ($C)",
            }.get(state, "look at the controller")
            raise TurntableError(f"turntable on {self.port} is in state {state}; {remedy}")

    def _report(self, line: str) -> TurntableStatus | None:
        """The state and angle in `<Run|MPos:1.0,0.0,0.0|WCO:...>`; None if noise has damaged it."""
        state, *fields = line.strip("<>").split("|")
        values: dict[str, list[float]] = {}
        try:
            for name, _, text in (field.partition(":") for field in fields):
                if name in ("MPos", "WPos", "WCO"):
                    values[name] = [float(number) for number in text.split(",")]
        except ValueError:
            return None
        self._offset = values.get("WCO", self._offset)
        at = _AXES.index(self.config.axis)
        position = values.get("WPos", values.get("MPos"))
        if position is None:
            return None
        if len(position) <= at:
            raise TurntableError(
                f"turntable on {self.port} reports {len(position)} axes, none is {self.config.axis};"
                f" give one of {', '.join(_AXES[: len(position)])}"
            )
        work = position[at]
        if "WPos" not in values and len(self._offset) > at:
            work -= self._offset[at]
        return TurntableStatus(state.split(":")[0], work * self.config.degrees_per_unit)

    def _alarm(self, line: str) -> None:
        if line.startswith("ALARM:"):
            words = ALARMS.get(int(line[6:]), "see the list of alarm codes of grbl")
            raise TurntableError(f"turntable on {self.port}: {line}, {words}")

    # ------------------------------------------------------------------------------------------------ the line

    def _open_line(self) -> serial.Serial:
        if self._line is None:
            raise ValueError(f"turntable on {self.port} is not open; use it in a `with` block")
        return self._line

    def _write(self, data: bytes) -> None:
        line = self._open_line()
        try:
            line.write(data)
        except (serial.SerialException, OSError) as error:
            raise self._lost(error) from None

    def _read_line(self, deadline: float) -> str | None:
        """The next line that is one of grbl's, without its end; None at the deadline. Garbage is counted, dropped."""
        port = self._open_line()
        while True:
            while (end := re.search(rb"[\r\n]", self._received)) is not None:
                raw = bytes(self._received[: end.start()])
                del self._received[: end.end()]
                text = "".join(chr(byte) for byte in raw if 0x20 <= byte < 0x7F)
                self.garbage += len(raw) - len(text)
                if _KNOWN.match(text):
                    return text
                self.garbage += len(text)
            if len(self._received) > _LONGEST:
                self.garbage += len(self._received)
                self._received.clear()
            if time.monotonic() >= deadline:
                return None
            try:
                self._received += port.read(max(1, port.in_waiting))
            except (serial.SerialException, OSError, TypeError) as error:  # TypeError: closed while it was read
                raise self._lost(error) from None

    def _lost(self, error: Exception) -> TurntableError:
        if isinstance(error, serial.SerialTimeoutException):
            return self._silent("what was sent")
        return TurntableError(f"turntable on {self.port} is gone ({one_line(error)}); check the cable and its power")

    def _silent(self, what: str) -> TurntableError:
        noise = f" and {self.garbage} bytes of garbage were seen" if self.garbage else ""
        return TurntableError(
            f"turntable on {self.port} does not answer {what}{noise}; check the cable, its power and the baud rate"
        )

    def _not_opened(self, error: Exception) -> str:
        number = getattr(error, "errno", None)
        if number == 2:
            found = ports()
            there = f"there are {', '.join(found)}" if found else "no serial port was found: plug the turntable in"
            return f"{self.port}: no such serial port; {there}"
        if number == 13:
            return f"{self.port}: not permitted; add yourself to the group that owns it (often dialout)"
        if number in (11, 16) or "lock" in str(error).lower():
            return f"{self.port} is busy: another program has it open; close that program"
        return f"{self.port} cannot be opened ({one_line(error)}); give a serial port, such as /dev/ttyUSB0"
