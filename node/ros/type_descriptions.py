"""~/get_type_description, as nodes of ROS 2 have it since Jazzy: what a type is made of, for who does not know it."""

from itertools import product
from typing import Any

from node.ros.bus import Bus
from node.ros.messages import FOLDER, Nodetype, make, type_hash, types

GET_TYPE_DESCRIPTION = "type_description_interfaces/srv/GetTypeDescription"
# type_description_interfaces/msg/FieldType
_IDS = {f"{sign}int{bits}": i for i, (bits, sign) in enumerate(product((8, 16, 32, 64), ("", "u")), 2)}
_IDS |= {"float32": 10, "float64": 11, "float128": 12, "char": 13, "bool": 15, "byte": 16, "string": 17}
_NESTED, _BOUNDED_STRING, _ARRAY, _BOUNDED, _UNBOUNDED = 1, 21, 48, 96, 144


def serve_type_descriptions(bus: Bus) -> None:
    """Offer the descriptions of all types that this node knows."""
    bus.serve("~/get_type_description", GET_TYPE_DESCRIPTION, _answer)


def _answer(request: Any) -> Any:
    kind = request.type_name
    try:
        known = type_hash(kind)
    except ValueError as error:
        return _response(successful=False, failure_reason=str(error))
    if request.type_hash not in ("", known):
        reason = f"{kind} has the hash {known} here, not {request.type_hash}: two versions of it are in use"
        return _response(successful=False, failure_reason=reason)
    found = description(kind)
    parts = [found["type_description"], *found["referenced_type_descriptions"]]
    first, *others = map(_individual, parts)
    described = _of("TypeDescription", type_description=first, referenced_type_descriptions=others)
    sources = filter(None, (_source(part["type_name"]) for part in parts)) if request.include_type_sources else ()
    return _response(successful=True, type_description=described, type_sources=list(sources))


def description(kind: str) -> dict[str, Any]:
    """A type and all that it is made of, as the JSON which its RIHS01 hashes (REP-2011).

    Raises ValueError for an unknown type.
    """
    type_hash(kind)
    found: dict[str, dict[str, Any]] = {}

    def add(name: str) -> None:
        if name not in found:
            found[name] = {"type_name": name}
            found[name]["fields"] = [field(of, part) for of, part in types().fielddefs[name][1]]

    def field(name: str, part: Any) -> dict[str, Any]:
        (of, inner), added, capacity = part, 0, 0
        if of in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (of, inner), capacity = inner
            added = _ARRAY if part[0] == Nodetype.ARRAY else _BOUNDED if capacity else _UNBOUNDED
        nested, text = (inner, 0) if of == Nodetype.NAME else ("", inner[1])
        if nested:
            add(nested)
        number = _NESTED if nested else _BOUNDED_STRING if text else _IDS[inner[0]]
        kinds = {"type_id": number + added, "capacity": capacity, "string_capacity": text, "nested_type_name": nested}
        return {"name": name, "type": kinds}

    add(kind)
    return {
        "type_description": found[kind],
        "referenced_type_descriptions": [found[name] for name in sorted(found) if name != kind],
    }


def _individual(part: dict[str, Any]) -> Any:
    fields = [_of("Field", name=f["name"], type=_of("FieldType", **f["type"])) for f in part["fields"]]
    return _of("IndividualTypeDescription", type_name=part["type_name"], fields=fields)


def _source(kind: str) -> Any:
    """The definition of one of this node's own types, with its comments. Nobody else's text is at hand."""
    package, folder, name = kind.split("/")
    path = FOLDER / folder / f"{name}.{folder}"
    if package != FOLDER.name or not path.is_file():
        return None
    text = path.read_text(encoding="utf-8")
    return _of("TypeSource", type_name=kind, encoding=folder, raw_file_contents=text)


def _of(name: str, /, **fields: Any) -> Any:
    return make(f"type_description_interfaces/msg/{name}", **fields)


def _response(**fields: Any) -> Any:
    return make(f"{GET_TYPE_DESCRIPTION}_Response", **fields)
