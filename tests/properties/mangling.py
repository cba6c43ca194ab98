"""How the tests of damaged files damage them, and what a reader may then say."""

import os
import random
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from node.__main__ import main

COUNT = int(os.environ.get("MANGLED", "40"))  # of each kind
FIRST = int(os.environ.get("MANGLED_FIRST", "0"))  # seed


def seeds(count: int = COUNT) -> range:
    """So many seeds, from `FIRST`."""
    return range(FIRST, FIRST + count)


SECONDS, MEGABYTES = 20.0, 1500.0  # that one file, and all of a test's, may take
VALUES = [None, True, -1, 0, 1e308, float("nan"), float("inf"), 10**30, "x", [], {}, [[1]], [1, 2, 3], {"a": 1}, 1e-300]
_NUMBERS = [0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1]  # lengths, counts, offsets


def mangled(data: bytes, rng: random.Random) -> bytes:
    """Bytes with some flipped, zeroed, doubled, replaced or cut off, or with another number in place of one."""
    at = rng.randrange(len(data))
    kind = rng.choice(["flip", "flip", "zero", "cut", "double", "noise", "number", "number"])
    if kind == "cut":
        return data[:at]
    if kind == "double":
        return data[:at] + data[at : at + rng.choice([1, 8, 100])] + data[at:]
    changed = bytearray(data)
    if kind == "flip":
        for _ in range(rng.choice([1, 1, 3, 20])):
            changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == "number":
        size = rng.choice([1, 2, 4, 4, 8])
        at = at // size * size if rng.random() < 0.5 else at
        old = int.from_bytes(data[at : at + size], "little")
        number = rng.choice([*_NUMBERS, old + 1, old - 1, 2 * old, -old]) % 2 ** (8 * size)
        changed[at : at + size] = number.to_bytes(size, rng.choice(["little", "little", "big"]))
    else:
        size = min(rng.choice([4, 64, 512]), len(data) - at)
        changed[at : at + size] = bytes(size) if kind == "zero" else rng.randbytes(size)
    return bytes(changed)


def another(values: Any, rng: random.Random) -> Any:
    """A tree of dictionaries and lists with one thing in it replaced, left out, nested deeper or put in twice."""
    if isinstance(values, dict | list) and values and rng.random() < 0.8:
        key = rng.choice([*values]) if isinstance(values, dict) else rng.randrange(len(values))
        changed = values.copy()
        what = rng.random()
        if what < 0.1:
            del changed[key]
        elif what < 0.2 and isinstance(changed, list):
            changed.insert(key, changed[key])
        else:
            changed[key] = another(values[key], rng)
        return changed
    if rng.random() < 0.1:
        for _ in range(rng.choice([1, 20])):
            values = [values]
        return values
    return rng.choice(VALUES)


@contextmanager
def bounded() -> Iterator[None]:
    """What runs in here takes bounded memory."""
    before = _peak_mb()
    yield
    assert _peak_mb() - before < MEGABYTES, f"from {before:.0f} to {_peak_mb():.0f} MB"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def refused(read: Callable[[], object], name: str) -> bool:
    """Whether a reader refuses what it is given; then in one line with `name` in it. Always within seconds."""
    begun = time.monotonic()
    try:
        read()
    except (ValueError, OSError) as error:
        said = str(error)
        assert "\n" not in said and name in said and len(said) < 2000, said
        return True
    finally:
        assert time.monotonic() - begun < SECONDS
    return False


def told(arguments: list[str], path: Path, out: Path, capfd: pytest.CaptureFixture) -> int:
    """Run the program; what it says must be one line that names the file, or nothing of an error."""
    begun = time.monotonic()
    code = main([str(argument) for argument in arguments])
    error = capfd.readouterr().err
    assert time.monotonic() - begun < SECONDS
    assert code in (0, 1), error
    if code == 1:
        assert error.startswith("farside: error: ") and error.count("\n") == 1 and "--debug" not in error, error
        assert str(path) in error, error
        assert not out.exists()
    out.unlink(missing_ok=True)
    return code
