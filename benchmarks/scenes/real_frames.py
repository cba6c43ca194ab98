"""Real frames of third parties, read in place beside the checkout: what stands in them, and where that is known."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
Box = tuple[int, int, int, int]  # x0 y0 x1 y1, px; ends exclusive


@dataclass(frozen=True)
class RealFrame:
    """A frame's folder below `DATA`, the names of its labelled things, and what else stands there and is a thing."""

    folder: str
    things: Mapping[int, str]  # by label; empty where the frame has no label map
    others: Mapping[str, Box] = field(default_factory=dict)  # drawn by eye, before anything was measured on them


FRAMES = {
    "ycbv 000002": RealFrame(
        "ycbv_000002",
        {1: "coffee can", 11: "pitcher", 3: "sugar box", 9: "meat can"},
        {"cracker box on the shelf, cut off": (0, 40, 90, 190)},
    ),
    "posecnn 1": RealFrame(
        "real/posecnn_1",
        {2: "cracker box", 4: "soup can", 5: "mustard bottle", 10: "banana", 15: "drill"},
        {
            "open carton behind the table's edge": (110, 10, 295, 240),
            "paper bag": (275, 90, 345, 170),
            "monitor": (0, 0, 110, 190),
            "box at the left edge, cut off": (0, 175, 50, 265),
        },
    ),
    "posecnn 3": RealFrame("real/posecnn_3", {4: "soup can", 9: "meat can", 13: "bowl"}),
    "mosd learn 33": RealFrame(
        "real/mosd_learn33", {1: "tin", 2: "pot", 3: "bowl", 4: "mug", 5: "mug"}, {"cabinet": (230, 0, 370, 60)}
    ),
    "mosd test 34": RealFrame(
        "real/mosd_test34",
        {1: "tin", 2: "can", 3: "can on the tin", 4: "mug", 5: "mug"},
        {"bin": (190, 0, 250, 70), "cabinet": (250, 0, 400, 90)},
    ),
    "pcl mug stereo": RealFrame("real/pcl_mug_stereo", {}, {"mug": (320, 200, 520, 410)}),
}


def frames() -> Iterator[tuple[str, RealFrame, Frame]]:
    """The frames, read. Raises `FileNotFoundError` where the data are not beside the checkout."""
    for name, real in FRAMES.items():
        yield name, real, read_frame_folder(DATA / real.folder)


@dataclass(frozen=True, eq=False)
class TrueObject:
    """A model at its true pose, metres."""

    points: Float[np.ndarray, "n 3"]  # surface, in the model's own frame
    T_camera_object: Float[np.ndarray, "4 4"]
    fit_mm: float = 0.0  # how far the pose was from the depth where it was fitted to it; 0: of the data set

    @property
    def in_camera(self) -> Float[np.ndarray, "n 3"]:
        return self.points @ self.T_camera_object[:3, :3].T + self.T_camera_object[:3, 3]

    def box_holds(self, camera_points: Float[np.ndarray, "m 3"], margin: float) -> Bool[np.ndarray, "m"]:
        """Which points (camera frame) lie in the model's box enlarged by `margin` on every side."""
        own = (camera_points - self.T_camera_object[:3, 3]) @ self.T_camera_object[:3, :3]
        low, high = self.points.min(axis=0) - margin, self.points.max(axis=0) + margin
        return np.all((own >= low) & (own <= high), axis=1)


def read_truth(folder: Path) -> dict[int, TrueObject]:
    """Models and true poses of a frame folder, by label; nothing where it has none."""
    meta = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
    result = {}
    for entry in meta.get("objects", ()):
        T = np.eye(4)
        T[:3] = np.array(entry["T_camera_object"])[:3]
        points = np.loadtxt(folder / "models" / f"{entry['name']}.xyz")
        result[int(entry["label"])] = TrueObject(points, T, float(entry.get("fit_mm", 0.0)))
    return result
