"""The table of `farside batch`: a row for each unit, from the units' records."""

import io
import re
from collections.abc import Collection
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from foundation.bounded import parse_json
from foundation.store import Store
from node.commands.batch_task import Record
from probnerf.types import KINDS

TABLE = "table.parquet"
_RECORD = re.compile(r"logs/[^/]+/(log|seed_\d+/object_-?\d+)(\.failed)?\.json")

SCHEMA = pa.schema(
    [
        ("log", pa.string()),  # where it is
        ("stamp_ns", pa.int64()),  # of the frame
        ("object", pa.int64()),  # null: of a log that could not be read
        ("label", pa.string()),
        ("seed", pa.int64()),  # null: of a log, or of something that was left out
        ("result", pa.string()),  # why the sampler stopped; `failed`; `left out`: it cannot be inferred
        ("error", pa.string()),  # why there is no result
        *((f"p_{kind}", pa.float64()) for kind in KINDS),  # null: not known
        *((name, pa.float64()) for name in ("width_m", "depth_m", "height_m")),
        ("out_of_model", pa.bool_()),
        *((name, pa.float64()) for name in ("explained", "expected_loss", "r_hat")),  # null: not known
        ("stage", pa.int64()),
        ("digest", pa.string()),  # of the shapes, their poses and weights
        ("bytes", pa.int64()),  # of the hypotheses file
        ("file", pa.string()),  # its name below the place of the results
        ("seconds", pa.float64()),  # of inference
    ]
)


def make_table(store: Store, settings: str, description: str, sizes: Collection[str]) -> pa.Table:
    """Write table.parquet from the records among these files, and give it. Equal records give equal bytes.

    `description` is kept in the file's metadata, as `farside`. Raises `ValueError` for a record that is damaged or of
    other settings, `StoreError`.
    """
    names = sorted(name for name in sizes if _RECORD.fullmatch(name))
    # of a unit that was done after it had failed, the failure may still be there
    names = [name for name in names if not (name.endswith(".failed.json") and name.replace(".failed", "") in sizes)]
    rows = list[dict[str, Any]]()
    for name, content in store.read(names).items():
        try:
            record = parse_json(content)
            if record["settings"] != settings:
                raise ValueError("it is of other settings")
            rows += _rows(name, record)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{store.path(name)} is no record of this run ({error}); remove it") from None
    for row in rows:
        if not isinstance(row["log"], str):
            raise ValueError(f"{store.url} holds a record of {str(row['log'])[:80]}, which is no log; remove it")
    rows.sort(key=lambda row: (row["log"], row.get("object") or -1, -1 if row.get("seed") is None else row["seed"]))
    table = pa.Table.from_pylist(rows, SCHEMA.with_metadata({"farside": description}))
    file = io.BytesIO()
    pq.write_table(table, file)
    store.write(TABLE, file.getvalue())
    return table


def _rows(name: str, record: Record) -> list[dict[str, Any]]:
    if "objects" in record:  # a log, whose units have records of their own
        same = {"log": record["log"], "stamp_ns": record["stamp_ns"], "result": "left out"}
        return [same | {"object": it["object"], "error": it["reason"]} for it in record["left_out"]]
    if record["result"] == "failed":
        return [record]
    width, depth, height = record["size_m"]
    return [
        record
        | {f"p_{kind}": p for kind, p in record["kinds"].items()}
        | {"width_m": width, "depth_m": depth, "height_m": height, "file": f"{name.removesuffix('.json')}.npz"}
    ]
