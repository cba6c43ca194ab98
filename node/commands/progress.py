"""Progress lines of inference: one an object, and one of the time that is left."""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from probnerf.sampling.hmc import StageInfo

_HOTTEST = 1e4  # temperature at which a bar begins


class InferenceProgress:
    """Lines for the objects with these ids: how cold each one's latest run is, or its share of `stages`.

    With a `budget` (s) there is a line for the scene, too. Within the context they are shown, on a terminal.
    """

    def __init__(self, ids: Sequence[int], stages: int | None, budget: float | None, err: Console) -> None:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
        self._stages, self._begun = stages, time.monotonic()
        self._bars = Progress(*columns, console=err, transient=True, disable=not err.is_terminal, redirect_stdout=False)
        self._tasks = {i: self._bars.add_task(f"object {i}: first, compiling", total=1.0) for i in ids}
        scene = budget is not None and len(ids) > 1
        self._scene = self._bars.add_task(f"of {budget:.0f} s for all", total=budget) if scene else None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def on_stage(self, object_id: int, info: StageInfo) -> None:
        """Show an object's stage."""
        beta, acceptance = min(info.beta), sum(info.acceptance) / len(info.acceptance)
        cold = 1.0 + math.log(max(beta, 1e-9), _HOTTEST)
        share = cold if self._stages is None else info.stage / max(self._stages, 1)
        text = f"object {object_id}: stage {info.stage}, temperature {1 / max(beta, 1e-9):.3g}"
        self._bars.update(
            self._tasks[object_id],
            description=f"{text}, acceptance {acceptance:.2f}",
            completed=min(max(share, 0.0), 1.0),
        )
        if self._scene is not None:
            self._bars.update(self._scene, completed=time.monotonic() - self._begun)

    def finished(self, object_id: int) -> None:
        """Take an object's line away."""
        self._bars.update(self._tasks[object_id], visible=False)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Within, no line is shown: for what is printed."""
        self._bars.stop()
        try:
            yield
        finally:
            self._bars.start()
