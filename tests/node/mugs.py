"""A simulated table as a frame folder, and hypotheses about a mug whose handle may be on either side."""

import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from calibration.camera import Camera
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.rays import observe
from perception.observation.segmentation import Segment
from perception.observation.visibility import seen_voxels
from perception.simulation.sensor_faults import simulate
from perception.simulation.simulated_camera import PlacedObject, TableScene, place_camera
from perception.sources.frame import Frame
from probnerf.objects.tabletop import signed_distance
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import Pose, StopReason

MUG = PlacedObject(2_900_727, 0.0, -0.06, np.pi)
CARTON = PlacedObject(2_900_483, 0.0, 0.09, 0.3)
CAMERA = Camera(240, 180, np.array([[230.0, 0, 120], [0, 230.0, 90], [0, 0, 1]]), np.zeros(5))


def table_frame() -> Frame:
    """A mug (label 1) and a carton (label 2) on a table."""
    return simulate(TableScene((MUG, CARTON)), CAMERA, place_camera((0.42, 0.0, 0.3), (0.0, 0.0, 0.03)), seed=0)


def write_folder(folder: Path, frame: Frame, **changes: np.ndarray) -> Path:
    """A frame folder; `changes` replace whole images (color, depth in mm, label)."""
    folder.mkdir(parents=True)
    images = {
        "color": frame.rgb[..., ::-1],
        "depth": np.rint(1000 * np.nan_to_num(frame.depth)).astype(np.uint16),
        "label": frame.label.astype(np.uint8),
        **changes,
    }
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), image)
    meta = {"camera_matrix_px": frame.camera.K.tolist(), "depth_unit_m": 0.001}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


_distance = jax.jit(lambda shape, pose, points: signed_distance(shape, pose.to_object(points)))


def mug_hypotheses(
    frame: Frame, found: Segment, yaws: list[float], weights: list[float], grid: int = 32, **changes
) -> Hypotheses:
    """The true mug's shape with its handle at some yaws of the view frame (0: towards the camera). Runs `observe`."""
    _, cube = observe(frame, found)
    scale = float(np.log(MUG.half_extent / cube.half_extent))
    fields = {
        "stamp_ns": frame.stamp_ns,
        "frame_id": frame.frame_id,
        "object_id": found.id,
        "label": "",
        "object_frame": cube,
        "T_world_camera": None,
        "opacity": np.stack([_opacity(yaw, scale, grid) for yaw in yaws]),
        "pose": np.array([[yaw, 0.0, 0.0, scale, 0.0] for yaw in yaws], np.float32),
        "weights": np.array(weights),
        "population": np.arange(len(yaws)) % 2,
        "seen": seen_voxels(frame, found, cube, grid),
        "inside_view": True,
        "out_of_model": False,
        "stage": 7,
        "monte_carlo_error": 0.01,
        "prior_hash": "",
        "seed": 0,
        "diagnostics": AnswerDiagnostics(acceptance=0.75, ess=12.0, log_evidence=-321.5, log_evidence_se=0.5),
        "result": StopReason.CONVERGED,
    }
    return Hypotheses(**{**fields, **changes})


def _opacity(yaw: float, scale: float, grid: int) -> np.ndarray:
    pose = Pose(*(jnp.asarray(v) for v in (yaw, 0.0, 0.0, scale, 0.0)))
    distance = np.asarray(_distance(MUG.shape, pose, jnp.asarray(voxel_centres(grid))))
    return np.where(distance <= 0.0, 255, 0).astype(np.uint8)
