"""The node's settings as read-only ROS 2 parameters: `ros2 param list`, `get` and `describe` work, `set` is refused."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np

from node.ros.bus import Bus
from node.ros.messages import make

Parameter = bool | int | float | str | tuple[str, ...]
MOST_NAMES = 1000  # of a request


def flat(config: object, prefix: str = "") -> dict[str, Parameter]:
    """A configuration's fields by dotted name. None is left out; any value that is not plain becomes its text."""
    found: dict[str, Parameter] = {}
    for field in fields(config):  # type: ignore[arg-type]
        name, value = f"{prefix}{field.name}", getattr(config, field.name)
        if is_dataclass(value):
            found |= flat(value, f"{name}.")
        elif isinstance(value, bool | int | float | str):
            found[name] = value
        elif isinstance(value, tuple) and all(isinstance(v, str) for v in value):
            found[name] = value
        elif value is not None:
            found[name] = str(value)
    return found


def serve_parameters(bus: Bus, parameters: Mapping[str, Parameter]) -> None:
    """Offer `parameters` under the node's name."""
    names = sorted(parameters)

    def reply(service: str, **response: Any) -> Any:
        return make(f"rcl_interfaces/srv/{service}_Response", **response)

    def listed(request: Any) -> Any:
        # depth 0: all names below a prefix; else names with at most `depth` more parts
        prefixes = [f"{p}." for p in request.prefixes] or [""]

        def below(name: str, p: str) -> bool:
            inside = name.startswith(p) or name == p[:-1]
            return inside and (not request.depth or name[len(p) :].count(".") < request.depth)

        kept = [name for name in names if any(below(name, p) for p in prefixes)]
        above = sorted({name.rpartition(".")[0] for name in kept} - {""})
        return reply("ListParameters", result=make(_kind("ListParametersResult"), names=kept, prefixes=above))

    def described(request: Any) -> Any:
        return reply(
            "DescribeParameters",
            descriptors=[
                make(_kind("ParameterDescriptor"), name=n, type=_value(parameters.get(n)).type, read_only=True)
                for n in request.names
            ],
        )

    reason = "the node's settings are read when it starts; change its configuration file"
    refusal = make(_kind("SetParametersResult"), successful=False, reason=reason)

    handlers = {
        "GetParameters": lambda r: reply("GetParameters", values=[_value(parameters.get(n)) for n in r.names]),
        "GetParameterTypes": lambda r: reply(
            "GetParameterTypes", types=np.array([_value(parameters.get(n)).type for n in r.names], np.uint8)
        ),
        "ListParameters": listed,
        "DescribeParameters": described,
        "SetParameters": lambda r: reply("SetParameters", results=[refusal] * len(r.parameters)),
        "SetParametersAtomically": lambda r: reply("SetParametersAtomically", result=refusal),
    }
    for service, handler in handlers.items():
        snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in service).strip("_")
        bus.serve(f"~/{snake}", f"rcl_interfaces/srv/{service}", partial(_of_few, handler))


def _of_few(handler: Callable[[Any], Any], request: Any) -> Any:
    """The handler's answer. Raises ValueError for a request of more names than any node has."""
    for field, asked in vars(request).items():
        if isinstance(asked, list) and len(asked) > MOST_NAMES:
            raise ValueError(f"{field} has {len(asked)} entries; give at most {MOST_NAMES}")
    return handler(request)


def _kind(name: str) -> str:
    return f"rcl_interfaces/msg/{name}"


def _value(value: Parameter | None) -> Any:
    """A ParameterValue; of None (no such parameter) that of type 0, not set."""
    match value:
        case None:
            found: dict[str, Any] = {"type": 0}
        case bool():
            found = {"type": 1, "bool_value": value}
        case int():
            found = {"type": 2, "integer_value": value}
        case float():
            found = {"type": 3, "double_value": value}
        case str():
            found = {"type": 4, "string_value": value}
        case _:
            found = {"type": 9, "string_array_value": list(value)}
    return make(_kind("ParameterValue"), **found)
