"""Small hypotheses without a picture: a body with a handle at one side or the other."""

import socket

import numpy as np

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import StopReason

GRID, HALF_EXTENT = 32, 0.16
BODY = ((-0.04, -0.04, -0.08), (0.04, 0.04, 0.08))  # metres, object frame
LEFT, RIGHT = ((0.04, -0.02, -0.04), (0.10, 0.02, 0.04)), ((-0.10, -0.02, -0.04), (-0.04, 0.02, 0.04))
STAMP_NS = 1_700_000_000_123_456_789


def body_with_handle(weights: tuple[float, float] = (0.3, 0.7), object_id: int = 1, **changes) -> Hypotheses:
    """Half a metre in front of a camera that looks along z and is turned a little; the half y >= 0 is unseen."""
    c, s = np.cos(0.4), np.sin(0.4)
    T = np.array([[1.0, 0, 0, 0.02 * object_id], [0, c, -s, -0.03], [0, s, c, 0.5], [0, 0, 0, 1]])
    centres = voxel_centres(GRID) * HALF_EXTENT
    shapes = [
        np.any([np.all((centres > low) & (centres < high), axis=-1) for low, high in boxes], axis=0)
        for boxes in ((BODY, LEFT), (BODY, RIGHT))
    ]
    fields = {
        "stamp_ns": STAMP_NS,
        "frame_id": "oak_rgb_camera_optical_frame",
        "object_id": object_id,
        "label": "mug",
        "object_frame": ObjectFrame(T, HALF_EXTENT, np.array([0.0, -0.6, -0.8, 0.4]), 0.05, 0.1),
        "T_world_camera": None,
        "opacity": (255 * np.stack(shapes)).astype(np.uint8),
        "pose": np.zeros((2, 5), np.float32),
        "weights": np.array(weights),
        "population": np.arange(2, dtype=np.int32),
        "seen": voxel_centres(GRID)[..., 1] < 0,
        "inside_view": True,
        "out_of_model": False,
        "stage": 4,
        "monte_carlo_error": 0.0125,
        "prior_hash": "ab12",
        "seed": 7,
        "diagnostics": AnswerDiagnostics(ess=12.5, explained=0.93),
        "result": StopReason.CONVERGED,
    }
    return Hypotheses(**{**fields, **changes})


def free_port() -> int:
    """A port of this machine that nobody listens on just now."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]
