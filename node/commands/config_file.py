"""Configuration files: YAML into the dataclasses that stand beside the code they configure.

A key is a field's name, a mapping fills a nested dataclass, and what is left out keeps its default. A key that no field
has is an error that names the nearest one; so is a value of another type than the field's.
"""

import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from foundation.one_line import one_line

T = TypeVar("T")


class _Loader(yaml.SafeLoader):
    """YAML in which no key stands twice; of two the plain loader would keep the last without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.YAMLError(f"line {node.start_mark.line + 1} and below give {key} twice; leave one out")
        return super().construct_mapping(node, deep)


def load_config(path: Path, into: type[T]) -> T:
    """The dataclass `into` filled from a YAML file.

    Raises FileNotFoundError, or ValueError naming the file, the key and the remedy.
    """
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such configuration file; see launch/replay.yaml for one") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML ({one_line(error)})") from None
    try:
        return from_mapping(into, {} if values is None else values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def from_mapping(into: type[T], values: object, where: str = "") -> T:
    """The dataclass `into` filled from nested mappings. `where` is the dotted key of `values`, for messages."""
    hints = get_type_hints(into)
    known = fields(into)  # type: ignore[arg-type]
    names = [f.name for f in known]
    if not isinstance(values, Mapping):
        raise ValueError(f"{where or 'the file'} is {values!r}; give a mapping with keys of {', '.join(names)}")
    arguments = {}
    for key, value in values.items():
        if key not in names:
            near = get_close_matches(str(key), names, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]}?" if near else f"its keys are {', '.join(names)}"
            raise ValueError(f"unknown key {_join(where, key)}; {hint}")
        arguments[key] = _value(hints[key], value, _join(where, key))
    missing = [f.name for f in known if f.default is f.default_factory is MISSING and f.name not in arguments]
    if missing:
        raise ValueError(f"{where or 'the file'} lacks {', '.join(missing)}")
    try:
        return into(**arguments)
    except ValueError as error:  # a configuration that checks itself
        raise ValueError(f"{where}: {error}" if where else str(error)) from None


def _join(where: str, key: object) -> str:
    return f"{where}.{key}" if where else str(key)


def _value(kind: Any, value: Any, where: str) -> Any:
    """`value` as the annotated type `kind`; numbers of YAML are not taken for strings, nor strings for numbers."""
    origin, options = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        first, *others = [option for option in options if option is not type(None)]
        for option in others:
            try:
                return _value(option, value, where)
            except ValueError:
                continue
        return _value(first, value, where)
    if origin is Literal:
        if value in options:
            return value
        raise ValueError(f"{where} is {value!r}; give one of {', '.join(map(str, options))}")
    if origin is tuple and isinstance(value, list):
        inner = options[:1] * len(value) if len(options) == 2 and options[1] is Ellipsis else options
        if len(inner) != len(value):
            raise ValueError(f"{where} has {len(value)} entries; give {len(inner)}")
        return tuple(_value(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(inner, value, strict=True)))
    if is_dataclass(kind):
        return from_mapping(kind, value, where)  # type: ignore[arg-type]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and number:
        return float(value)
    if (kind is int and number and float(value).is_integer()) or (kind is bool and isinstance(value, bool)):
        return kind(value)
    if kind in (str, Path) and isinstance(value, str):
        return kind(value)
    raise ValueError(f"{where} is {value!r}; give {_NAMES.get(kind, 'another value')}")


_NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "a text", Path: "a path"}
