"""Names of topics: which ones are chosen, and which images a name indicates. Standard library only."""

import re
from dataclasses import dataclass

# A depth camera's other images, and those of this node.
NO_DEPTH_PARTS = {
    *("confidence", "uncertainty", "variance", "covariance", "sigma", "std", "stddev", "error", "noise", "quality"),
    *("disparity", "amplitude", "intensity", "probability", "mask", "weight", "weights", "normal", "normals"),
}


def name_parts(topic: str) -> set[str]:
    """The words of a topic's name, in small letters, parted at everything that is no letter."""
    return set(re.findall("[a-z]+", topic.lower()))


def is_rectified(topic: str) -> bool:
    """Whether an image topic's name says that its images are rectified."""
    return bool({"rect", "rectified"} & name_parts(topic))


def named_otherwise(topic: str) -> str | None:
    """The part of a topic's name that says that its images are not depth."""
    return next(iter(sorted(NO_DEPTH_PARTS & name_parts(topic))), None)


@dataclass(frozen=True)
class TopicNames:
    """Topics of a recording that the user names; None: found automatically."""

    colour: str | None = None
    depth: str | None = None  # counts as aligned to colour, with any frame_id
