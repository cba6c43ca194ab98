"""What happens to every frame of a live node, used for inference or not."""

import threading
from collections import deque
from collections.abc import Callable

from node.ros.publishers import Announcer
from perception.sources.frame import Frame
from perception.sources.reader import Listener
from perception.sources.recorder import Recorder

KEPT = 1000  # stamps of recorded frames that are remembered


class Keeper:
    """Takes every frame: to the recording and to who listens on the bus."""

    def __init__(
        self,
        listener: Listener,
        recorder: Recorder | None,
        announcer: Announcer | None,
        trouble: Callable[[str], object],
    ) -> None:
        self.thread = threading.Thread(target=self._run, name="farside keeper", daemon=True)
        self._listener, self._recorder, self._announcer = listener, recorder, announcer
        self._trouble = trouble
        self._recorded: deque[int] = deque(maxlen=KEPT)

    def has(self, frame: Frame) -> bool:
        """The recording has this frame, or there is no recording."""
        return self._recorder is None or self._recorder.error is not None or frame.stamp_ns in self._recorded

    def close(self) -> None:
        """Wait until all that came is handed on."""
        if self.thread.ident is not None:
            self.thread.join(10.0)

    def _run(self) -> None:
        while True:
            try:
                frame = self._listener.take(0.5)
            except Exception:  # the main thread reports the source's end
                return
            if frame is None:
                if self._listener.ended:
                    return
                continue
            try:
                if self._recorder is not None and self._recorder.write_frame(frame):
                    self._recorded.append(frame.stamp_ns)
                if self._announcer is not None:
                    self._announcer.frame(frame)
            except ValueError as error:  # one frame that no message can hold must not end all
                self._trouble(str(error))
