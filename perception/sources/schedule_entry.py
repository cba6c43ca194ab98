"""The schedule of a recording: which frames were inferred, and everything needed to repeat the inference.

Each inference is one std_msgs/String on `SCHEDULE_TOPIC`, which holds a JSON object: `version` and the fields of
`Scheduled` by their names. A Farside that finds a higher version than its own refuses it.
"""

import json
from dataclasses import asdict, dataclass, fields
from typing import Literal, Self, get_args

SCHEDULE_TOPIC = "/farside/schedule"
VERSION = 1
StartedFrom = Literal["fresh", "tracked"]
_TYPES = {"stamp_ns": int, "object_id": int, "stages": int, "seed": int}  # the others are text


@dataclass(frozen=True)
class Scheduled:
    """One inference: the frame of this stamp, the settings, and the result's digest."""

    stamp_ns: int  # of the frame
    object_id: int  # as `segment` numbers it in this frame
    stages: int  # limit of the sampler, or reached within its budget
    seed: int
    prior_hash: str
    config_hash: str  # see `inference.schedule.config_hash`
    digest: str  # of the resulting hypotheses; see `inference.schedule.digest`
    started_from: StartedFrom = "fresh"

    def to_json(self) -> str:
        """The text of the message."""
        return json.dumps({"version": VERSION, **asdict(self)}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse. Raises ValueError for a newer version and for text that is not an entry."""
        try:
            values = json.loads(text)
            version = values.pop("version")
        except (AttributeError, KeyError, TypeError, ValueError):
            raise ValueError(f"{text[:60]!r} is not an entry of a schedule; record it again") from None
        if version != VERSION:
            raise ValueError(f"the schedule has version {version}, and this Farside follows {VERSION}: update Farside")
        names = [f.name for f in fields(cls)]
        if sorted(values) != sorted(names):
            raise ValueError(f"an entry of the schedule has fields {sorted(values)}; {sorted(names)} are wanted")
        for name, value in values.items():
            if type(value) is not _TYPES.get(name, str):
                raise ValueError(f"an entry of the schedule has {name} {value!r}; record it again")
        if values["started_from"] not in get_args(StartedFrom):
            raise ValueError(f"an inference of the schedule started from {values['started_from']!r}: update Farside")
        return cls(**values)
