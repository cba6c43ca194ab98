"""A stand-in for a turntable's controller: grbl 1.1 as its documents describe it, behind a pseudo-terminal."""

import os
import pty
import select
import threading
import time
import tty
from dataclasses import dataclass, field


@dataclass
class Grbl:
    """The controller. Faults are switched on by fields; `received` is every line that came."""

    boot: float = 0.0  # s that it ignores its input
    silent: bool = False  # never answers
    silent_after: str = ""  # falls silent when a line begins so
    garbage: bytes = b""  # sent before every answer
    glued: bytes = b""  # sent right before every `ok`
    only_garbage: bool = False
    alarm_on: str = ""  # a line that begins so ends in ALARM:alarm
    alarm: int = 1
    refuse: str = ""  # a line that begins so ends in error:error
    error: int = 20
    locked: bool = False  # starts in the alarm state, as after power-up with homing on
    hang_up_on: str = ""  # the cable is pulled when a line begins so
    hang_up_moving: bool = False  # or while the table turns
    stuck: bool = False  # accepts motion but does not move
    speed: float = 4000.0  # units per second
    stale: bytes = b""  # what the last user of the port left unread
    wco: float = 0.0
    received: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self.position, self.target, self.begun, self.origin = self.wco, self.wco, 0.0, self.wco
        self.state_alarm, self.stop = self.locked, threading.Event()
        self.reports = 0
        self.holds = 0
        self.closed = False
        self.thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> "Grbl":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join(5)
        self._hang_up()

    @property
    def angle(self) -> float:
        """Machine position now."""
        gone = (time.monotonic() - self.begun) * self.speed
        distance = self.target - self.origin
        if self.stuck:
            return self.origin
        return self.target if gone >= abs(distance) else self.origin + gone * (1 if distance > 0 else -1)

    @property
    def moving(self) -> bool:
        return self.angle != self.target and not self.stuck

    def _hang_up(self) -> None:
        if not self.closed:
            self.closed = True
            os.close(self.slave)
            os.close(self.master)

    def _send(self, text: str) -> None:
        if self.silent or self.closed:
            return
        body = b"" if self.only_garbage else text.encode() + b"\r\n"
        os.write(self.master, self.garbage + (self.glued if text == "ok" else b"") + body)

    def _serve(self) -> None:
        power, line = time.monotonic(), b""
        if self.stale:
            os.write(self.master, self.stale)
        while not self.stop.is_set() and not self.closed:
            if self.hang_up_moving and self.moving:
                return self._hang_up()
            if not select.select([self.master], [], [], 0.005)[0]:
                continue
            try:
                data = os.read(self.master, 256)
            except OSError:
                return
            if time.monotonic() - power < self.boot:
                continue
            for byte in data:
                if byte == 0x18:
                    line = b""
                    self.state_alarm |= self.moving
                    self.target = self.origin = self.angle
                    self._send("\r\nGrbl 1.1h ['$' for help]")
                elif byte == ord("?"):
                    self._send(self._report())
                elif byte == ord("!"):
                    self.holds += 1
                    self.target = self.origin = self.angle
                elif byte == ord("\n"):
                    self._line(line.decode().strip())
                    line = b""
                elif byte != ord("\r"):
                    line += bytes([byte])

    def _report(self) -> str:
        state = "Alarm" if self.state_alarm else "Run" if self.moving else "Idle"
        self.reports += 1
        more = f"|WCO:{self.wco:.3f},0.000,0.000" if self.reports % 10 == 1 else ""
        return f"<{state}|MPos:{self.angle:.3f},0.000,0.000|FS:0,0{more}>"

    def _line(self, text: str) -> None:
        self.received.append(text)
        if self.hang_up_on and text.startswith(self.hang_up_on):
            return self._hang_up()
        if self.silent_after and text.startswith(self.silent_after):
            self.silent = True
        if self.alarm_on and text.startswith(self.alarm_on):
            self.state_alarm = True
            return self._send(f"ALARM:{self.alarm}")
        if self.refuse and text.startswith(self.refuse):
            return self._send(f"error:{self.error}")
        if text == "$X":
            self.state_alarm = False
        elif text == "$H":
            self.state_alarm = False
            self.target = self.origin = self.wco
        elif self.state_alarm and text:
            return self._send("error:9")
        elif text.startswith("G92X"):
            self.wco = self.angle
            self.reports = 0  # grbl reports a new offset at once
        elif "G1X" in text:
            self.origin, self.begun = self.angle, time.monotonic()
            self.target = float(text.split("G1X")[1].split("F")[0]) + self.wco
        self._send("ok")
