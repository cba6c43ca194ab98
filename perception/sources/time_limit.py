"""A time limit for a call that may hang, such as a device's."""

import threading
from collections.abc import Callable
from queue import Empty, Queue

from perception.sources.reader import Result


def within(
    limit_s: float, call: Callable[[], Result], complaint: str, late: Callable[[Result], object] | None = None
) -> Result:
    """The result of `call`, or its exception. `OSError` with the complaint if it takes longer; the call is then
    abandoned.

    A later result is passed to `late`, which closes it.
    """
    finished: Queue[Result | Exception] = Queue()
    settled = threading.Lock()  # taken by the first of the two: the caller's timeout or the result

    def work() -> None:
        try:
            result = call()
        except Exception as error:  # raised again in the caller's thread
            finished.put(error)
            return
        if settled.acquire(blocking=False):
            finished.put(result)
        elif late is not None:
            late(result)

    threading.Thread(target=work, name="farside device", daemon=True).start()
    try:
        result = finished.get(timeout=limit_s)
    except Empty:
        if settled.acquire(blocking=False):
            raise OSError(complaint) from None
        result = finished.get()  # it came at the last moment
    if isinstance(result, Exception):
        raise result
    return result
