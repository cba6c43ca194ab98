"""What comes from outside, checked against limits before it is built, quoted or allocated."""

import json
import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from foundation.one_line import one_line

MOST_VALUES = 100_000  # of a parsed text; aliases of YAML count as often as they are used
LARGEST_ARRAYS = 1 << 30  # bytes, of all arrays of a file
LARGEST_YAML = 1 << 18  # bytes of text, which take seconds
_LARGEST_TEXT = 1 << 24
_MOST_LEVELS = 100


def read_text(path: Path, most: int = _LARGEST_TEXT) -> str:
    """The text of a file of at most `most` bytes; no more of it is read. Raises OSError, ValueError for another."""
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"it has more than {most >> 10} kB")
    return data.decode("utf-8-sig")


def check_nesting(text: str) -> None:
    """Raises ValueError for YAML that is nested deeper than `_MOST_LEVELS`, before any of it is built."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MOST_LEVELS:
            raise ValueError("it is nested too deep")


class Merging:
    """Counts the keys that mappings of one text merge (<<), before they are copied: repeated, they multiply.

    Mixed into PyYAML's and ruamel's constructors. ValueError beyond `MOST_VALUES`.
    """

    _merged = 0

    def flatten_mapping(self, node: Any) -> None:
        """Copies the merged keys of a mapping's node into it, as the constructor does."""
        for key, of in node.value:
            if key.value == "<<":
                self._merged += sum(len(one.value) for one in (of.value if of.id == "sequence" else [of]))
        if self._merged > MOST_VALUES:
            raise ValueError(f"it holds more than {MOST_VALUES} values, merged keys counted")
        super().flatten_mapping(node)  # type: ignore[misc]


class _Loader(Merging, yaml.SafeLoader):
    pass


def parse_yaml(text: str) -> Any:
    """The content of a text in YAML 1.1, as ROS and its tools write it.

    Raises ValueError for what is none, is too large or is nested too deep.
    """
    try:
        if len(text) > LARGEST_YAML:
            raise ValueError(f"it has more than {LARGEST_YAML >> 10} kB, the most of YAML")
        check_nesting(text)
        content = yaml.load(text, _Loader)
        check_size(content)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(one_line(error)) from None
    except Exception:  # `!!bool x` fails in many ways
        raise ValueError("a value does not fit its tag (!!)") from None
    return content


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. Raises ValueError for what is no JSON, is too large, or is nested too deep."""
    if len(text) > _LARGEST_TEXT:
        raise ValueError(f"it has more than {_LARGEST_TEXT >> 10} kB")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def check_size(content: object) -> None:
    """Raises ValueError where nested mappings and lists hold more than `MOST_VALUES`."""
    count, waiting = 0, [content]
    while waiting:
        value = waiting.pop()
        count += 1
        if count + len(waiting) > MOST_VALUES:
            raise ValueError(f"it holds more than {MOST_VALUES} values, repeated aliases counted")
        if isinstance(value, Mapping):
            waiting.extend(value.values())
        elif isinstance(value, list | tuple):
            waiting.extend(value)


def check_arrays(path: Path, names: Collection[str] | None = None, most: int = LARGEST_ARRAYS) -> None:
    """Raises ValueError where arrays of an .npz file have more than `most` bytes in all, or one not as many as it says.

    `names` are those that are looked at, in small letters; None: all. Raises zipfile.BadZipFile for another file.
    """
    total = 0
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy").lower()
            if not info.filename.endswith(".npy") or (names is not None and name not in names):
                continue
            with archive.open(info) as member:
                try:
                    old = np.lib.format.read_magic(member) == (1, 0)
                    header = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
                    shape, _, dtype = header(member)
                except Exception as error:  # NumPy parses the header as Python, which has many ways to fail
                    raise ValueError(f"{info.filename} has no readable header: {one_line(error)[:100]}") from None
                held = info.file_size - member.tell()
            size = math.prod(shape) * dtype.itemsize
            if not dtype.hasobject and size != held:
                raise ValueError(f"{info.filename} says it has {size} bytes, and has {held}")
            total += held
            if held > most:
                raise ValueError(f"{info.filename} unpacks to {held >> 20} MB")
            if total > most:
                raise ValueError(f"its arrays unpack to more than {most >> 20} MB")
