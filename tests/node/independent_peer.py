"""A ROS 2 node that shares no code with this project (`tests/peer`, by hiroz) as another process, for the tests."""

import json
import os
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE
from types import TracebackType
from typing import Any, Self

import numpy as np

from node.ros.foreign_types import MESSAGES, SERVICES
from node.ros.messages import FOLDER
from tests.conftest import ROOT

CRATE = ROOT / "tests" / "peer"
BUILD = "cargo build --locked --manifest-path tests/peer/Cargo.toml"
BINARY = Path(os.environ.get("CARGO_TARGET_DIR", CRATE / "target")) / "debug" / "farside-peer"
FOREIGN = ("moveit_msgs", "nvblox_msgs", "object_recognition_msgs", "octomap_msgs")  # hiroz has the others itself


class IndependentPeer:
    """Takes commands and tells what it hears, in JSON: `tests/peer/src/main.rs` has both. `definitions` is a folder for
    the types that hiroz lacks.
    """

    def __init__(self, endpoint: str, definitions: Path) -> None:
        for name, text in (MESSAGES | SERVICES).items():
            package, folder, kind = name.split("/")
            if package in FOREIGN:
                path = definitions / package / folder / f"{kind}.{folder}"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        packages = [str(FOLDER), *(str(definitions / package) for package in FOREIGN)]
        self._command = [str(BINARY), endpoint, *packages]
        self.lines: list[dict[str, Any]] = []
        self._changed = threading.Condition()

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(self._command, stdin=PIPE, stdout=PIPE, text=True)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()
        try:
            self.wait(lambda line: line["what"] == "ready")
        except AssertionError:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._changed:
                self.lines.append(json.loads(line))
                self._changed.notify_all()
        with self._changed:
            self.lines.append({"what": "end"})
            self._changed.notify_all()

    def tell(self, **command: Any) -> None:
        """Give a command."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()

    def wait(self, wanted: Callable[[dict[str, Any]], object], seconds: float = 60.0, after: int = 0) -> dict[str, Any]:
        """The first line after so many that is wanted."""
        deadline = time.monotonic() + seconds
        with self._changed:
            while True:
                for line in self.lines[after:]:
                    if wanted(line):
                        return line
                left = deadline - time.monotonic()
                if left <= 0 or {"what": "end"} in self.lines[-1:] or not self._changed.wait(left):
                    raise AssertionError(f"nothing of this kind in {seconds:g} s; last: {self.lines[-3:]}")

    def call(self, service: str, kind: str, seconds: float = 120.0, /, **request: Any) -> dict[str, Any]:
        """The line about a service's response, or about the error of the call."""
        after = len(self.lines)
        self.tell(call=service, type=kind, request=request)
        return self.wait(lambda line: line["what"] == "answer" or "command" in line, seconds, after)

    def graph(self, node: str) -> list[dict[str, Any]]:
        """What a node publishes, takes and serves, as the peer sees it."""
        after = len(self.lines)
        self.tell(graph=node)
        self.wait(lambda line: line["what"] == "graph", after=after)
        return [line for line in self.lines[after:] if line["what"] == "endpoint"]

    def heard(self, topic: str) -> list[dict[str, Any]]:
        """What came on a topic so far."""
        return [line for line in self.lines if line["what"] == "heard" and line["name"] == topic]


def as_json(message: Any) -> Any:
    """A message as the peer takes it: bytes are hex digits."""
    if isinstance(message, np.ndarray):
        return message.tobytes().hex() if message.dtype == np.uint8 else message.tolist()
    if isinstance(message, list):
        return [as_json(it) for it in message]
    if hasattr(message, "__msgtype__"):
        return {name: as_json(value) for name, value in vars(message).items() if name != "__msgtype__"}
    return message.item() if isinstance(message, np.generic) else message
