"""The folder of a training run: recipe, checkpoint and history. A killed run goes on as if nothing had happened."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx

from foundation.one_line import one_line
from foundation.whole_file import whole_file

S = TypeVar("S")


class RunFolder:
    """`config.json`, `checkpoint.eqx` and `history.jsonl` of one run. `config` is the recipe, a dataclass."""

    def __init__(self, folder: Path, config: Any) -> None:
        self.checkpoint = folder / "checkpoint.eqx"
        self._folder, self._history, self._settings = folder, folder / "history.jsonl", folder / "config.json"
        self._described = json.dumps(asdict(config), indent=1)

    def resume(self, state: S) -> S:
        """The checkpoint's state, or `state` in a new folder.

        `state` has an array `step`. Later lines of the history are removed. Raises ValueError if the folder holds a run
        of another recipe, or a checkpoint that cannot be read.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint.exists():
            if self._settings.exists() and self._settings.read_text() != self._described:
                raise ValueError(
                    f"{self._folder} holds a run of another recipe: see {self._settings}, or give a fresh --out"
                )
            try:
                state = eqx.tree_deserialise_leaves(self.checkpoint, state)
                step = int(state.step)  # type: ignore[attr-defined]
            except Exception as error:  # NumPy's and Equinox's readers fail in many ways
                raise ValueError(
                    f"{self.checkpoint} is damaged, or of another model ({one_line(error)[:200]}); remove it to begin"
                    " anew, or give a fresh --out"
                ) from None
            try:
                lines = self._history.read_text().splitlines() if self._history.exists() else []
                kept = [line for line in lines if json.loads(line)["step"] <= step]
            except (KeyError, TypeError, ValueError, RecursionError):
                raise ValueError(f"{self._history} is damaged; remove it, and the curves begin here") from None
            self._history.write_text("".join(line + "\n" for line in kept))
        self._settings.write_text(self._described)
        return state

    def record(self, metrics: dict[str, Any]) -> None:
        """Append a line to the history. `metrics` has the `step`."""
        with open(self._history, "a") as file:
            file.write(json.dumps(metrics) + "\n")

    def save(self, state: Any) -> None:
        """Write the checkpoint atomically: a killed run leaves the old file or the new one."""
        with whole_file(self.checkpoint) as part, part.open("wb") as file:
            eqx.tree_serialise_leaves(file, state)
            file.flush()
            os.fsync(file.fileno())
