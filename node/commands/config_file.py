"""Configuration files: YAML into the dataclasses of `node.commands.options`, strictly.

A key is a field's name, a mapping fills a nested dataclass, and what a file omits keeps its default. A key that no
field has is an error that names the nearest one; a value of another type than the field's is an error, too.
"""

import json
import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError, SafeConstructor

from foundation.bounded import LARGEST_YAML, Merging, check_nesting, check_size, read_text
from foundation.one_line import one_line

T = TypeVar("T")

# What to give where pydantic finds another type.
_REMEDIES = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "path_type": "a path",
    "string_type": "a text",
    "tuple_type": "a list, such as [1, 2]",
}


class _Constructor(Merging, SafeConstructor):
    pass


def load_config(path: Path, into: type[T]) -> T:
    """The dataclass `into` filled from a YAML file.

    Raises FileNotFoundError, or ValueError naming the file, the key and the remedy.
    """
    try:
        loader = YAML(typ="safe", pure=True)
        loader.Constructor = _Constructor
        text = read_text(path, LARGEST_YAML)
        check_nesting(text)  # ruamel takes minutes
        values = loader.load(text)
        check_size(values)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such configuration file; see launch/replay.yaml for one") from None
    except DuplicateKeyError as error:
        assert error.problem is not None and error.problem_mark is not None
        where = f"line {error.problem_mark.line + 1}: {error.problem}"
        raise ValueError(f"{path} is not YAML ({where}; omit one of them)") from None
    except Exception as error:  # tags that do not fit (`!!bool x`) fail in many ways
        raise ValueError(f"{path} is not YAML ({one_line(error)})") from None
    try:
        return from_mapping(into, {} if values is None else values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def from_mapping(into: type[T], values: object) -> T:
    """The dataclass `into` filled from nested mappings. Raises ValueError naming the key and the remedy."""
    if isinstance(values, Mapping):
        made = {f.name: f.default_factory() for f in fields(into) if f.default_factory is not MISSING}  # type: ignore[arg-type]
        values = {key: _over(made.get(key), value) for key, value in values.items()}
    # JSON has lists and texts where dataclasses have tuples and paths; strict reading of it converts nothing else.
    text = json.dumps(values, default=_plain)
    try:
        return TypeAdapter(into).validate_json(text, strict=True, extra="forbid")
    except ValidationError as errors:
        raise ValueError(_complaint(into, errors)) from None


def _plain(value: Any) -> Any:
    """What JSON has no notation for: dataclasses, and paths and dates, as texts."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


def _over(default: object, values: object) -> object:
    """`values` of a nested dataclass, and those of its default that they omit."""
    if not is_dataclass(default) or not isinstance(values, Mapping):
        return values
    return vars(default) | {key: _over(vars(default).get(key), value) for key, value in values.items()}


def _complaint(into: type, errors: ValidationError) -> str:
    """The first error in one line."""
    error = errors.errors()[0]
    path, value, kind = error["loc"], error["input"], error["type"]
    where, above, shown = _dotted(path), path[:-1], reprlib.repr(value)
    if kind == "value_error":  # a configuration that checks itself
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    if kind == "unexpected_keyword_argument":
        names = _keys(into, above)
        near = get_close_matches(str(path[-1]), names, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}?" if near else f"its keys are {', '.join(names)}"
        return f"unknown key {where}; {hint}"
    if kind == "missing" and isinstance(path[-1], str):
        return f"{_dotted(above) or 'the file'} lacks {path[-1]}"
    if kind == "missing":
        return f"{_dotted(above)} is {shown}; give more entries"
    if kind == "dataclass_type":
        return f"{where or 'the file'} is {shown}; give a mapping with keys of {', '.join(_keys(into, path))}"
    if kind == "too_long":
        return f"{where} is {shown}; give {error['ctx']['max_length']} entries"
    if kind == "literal_error":
        return f"{where} is {shown}; give {error['ctx']['expected']}"
    return f"{where} is {shown}; " + (f"give {_REMEDIES[kind]}" if kind in _REMEDIES else error["msg"])


def _dotted(path: tuple[int | str, ...]) -> str:
    """inner.turns[1]"""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


def _keys(into: Any, path: tuple[int | str, ...]) -> list[str]:
    """Names of the fields of the dataclass at a path."""
    for part in path:
        into = get_type_hints(into)[str(part)]
    return [f.name for f in fields(into)]
