"""Farside's public API: a frame in, whole weighted shapes out, and questions about the space that nobody has seen.

    import farside

    frame = farside.read_frame("my_frame/")
    scene = farside.estimate(frame)
    answer = farside.query(scene, farside.Box((-0.05, -0.05, 0.5), (0.05, 0.05, 0.6)), frame="camera")
    print(answer.p_free, answer.verdict(risk=0.05))

Arrays are NumPy's and lengths are metres. Errors are those of the command line: `ValueError` or `OSError` with one line
that names the file, the value and the remedy. `farside.api` lists all names; they are imported when the first one is
used.

Compiled programs are kept in the user's cache folder between processes; set `FARSIDE_PROGRAMS` to an empty string
before the import to keep none.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

from probnerf.environment import prepare

__version__ = "0.2.0"

if TYPE_CHECKING:
    from farside.api import *  # noqa: F403


def _api() -> ModuleType:
    prepare()  # before anything imports JAX
    return importlib.import_module("farside.api")


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    api = _api()
    if name not in api.__all__:
        raise AttributeError(f"module 'farside' has no attribute {name!r}; it has {', '.join(api.__all__)}")
    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_api().__all__})
