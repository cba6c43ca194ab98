"""All public names: types and functions of the packages below, and the steps that join them."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.camera_file import read_camera
from perception.answers.hypotheses import FrameName, Hypotheses, mesh, meshes
from perception.answers.hypotheses_file import frame_path, hypotheses_path, load_scene
from perception.answers.hypotheses_file import save as save_hypotheses
from perception.answers.next_view import RankedViews, rank_views, ring_of_views
from perception.answers.query import QueryResult
from perception.answers.query import query as ask
from perception.answers.regions import Box, Cells, Points, Region, Swept, read_mesh
from perception.answers.scene import Scene
from perception.inference.controller import inference_of
from perception.inference.inference import Inference
from perception.inference.limits import Callbacks, Limits
from perception.inference.scene import estimate_scene
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker
from perception.observation.segmentation import Segment, Segments, segment
from perception.observation.settings import SegmentConfig
from perception.sources.frame import Frame
from perception.sources.frame_folder import write_frame_folder
from perception.sources.open_source import open_source
from perception.sources.playback import frame_at
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.sampling.hmc import StageInfo

__all__ = [
    "Box",
    "Camera",
    "Cells",
    "ControllerConfig",
    "Frame",
    "Hypotheses",
    "Points",
    "Prior",
    "QueryResult",
    "RankedViews",
    "Region",
    "Scene",
    "Segment",
    "SegmentConfig",
    "Segments",
    "StageInfo",
    "Swept",
    "Tracker",
    "estimate",
    "load",
    "load_prior",
    "mesh",
    "meshes",
    "next_views",
    "open_source",
    "query",
    "read_camera",
    "read_frame",
    "read_mesh",
    "ring_of_views",
    "save",
    "segment",
]

Objects = Sequence[Hypotheses] | Hypotheses


def read_frame(source: str | Path | None = None, index: int = 0, camera: Camera | None = None) -> Frame:
    """Frame `index` (-1: the last) of a frame folder or a recording. Without a source: the recording that ships with
    Farside.

    `camera` replaces the source's own calibration. Raises `FileNotFoundError` or `ValueError`.
    """
    return frame_at(source, index, camera=camera)[0]


def estimate(
    frame: Frame,
    segments: Sequence[Segment] | Segment | None = None,
    *,
    prior: Prior | None = None,
    config: ControllerConfig | None = None,
    seed: int = 0,
    budget_s: float | None = 90.0,
    stages: int | None = None,
    on_progress: Callable[[int, StageInfo], bool | None] | None = None,
) -> Scene:
    """Infer the objects of a frame: all that `farside.segment` finds, or only `segments`.

    `budget_s` is shared by the objects (None: no limit, each runs until it has converged). `stages` limits the
    sampler's stages for each object. Without a budget the answer depends on the arguments alone. `on_progress` is
    called after every stage with the object's id and the sampler's state. If it returns True, inference ends, and the
    present answer is returned. An object that cannot be inferred is named in `Scene.left_out`; if no object can be, its
    `ValueError` is raised.
    """
    begun = time.monotonic()
    if budget_s is not None and not budget_s > 0:
        raise ValueError(f"budget_s is {budget_s:g}; give more than 0, or None for no limit")
    if segments is None:
        segments = segment(frame)
    elif isinstance(segments, Segment):
        segments = [segments]
    elif not all(isinstance(found, Segment) for found in segments):
        raise ValueError(
            "segments must come from farside.segment; give a label map to the frame: farside.Frame(..., label=labels)"
        )
    weights = load_prior() if prior is None else prior

    def start(found: Segment, deadline: float | None) -> Inference:
        on_stage = None if on_progress is None else partial(on_progress, found.id)
        limits, callbacks = Limits(deadline, stages), Callbacks(on_stage)
        return inference_of(frame, found, weights, config, seed=seed, limits=limits, callbacks=callbacks)

    left_out = {it.id: it.reason for it in segments.left_out} if isinstance(segments, Segments) else {}
    done = []
    complaint = ValueError("there is no segment to infer; give at least one")
    for found, result in estimate_scene(segments, start, None if budget_s is None else begun + budget_s):
        if isinstance(result, ValueError):
            left_out[found.id], complaint = str(result), result
        else:
            done.append(result.hypotheses)
    if not done:
        raise complaint
    return Scene(tuple(sorted(done, key=lambda h: h.object_id)), left_out)


def query(scene: Objects, region: Region, frame: FrameName = "camera", now_ns: int | None = None) -> QueryResult:
    """How likely a region (metres, in `frame`) is free, jointly over all hypotheses and objects.

    Frames: "camera" (x right, y down, z forward), "object" (of a single object: z up, x towards the camera), "world" if
    the camera's pose is known. `now_ns` is the time at which the answer's age is taken (None: now). Raises
    `ValueError`.
    """
    return ask(_objects(scene), region, frame, now_ns)


def next_views(scene: Objects, cameras: Float[np.ndarray, "c 4 4"] | None = None, count: int = 5) -> RankedViews:
    """The `count` camera poses with the largest expected information gain, best first.

    `cameras` are the candidates, T_object_camera in the first object's frame, metres (None: a ring around it). Raises
    `ValueError`.
    """
    return rank_views(_objects(scene), cameras, count)


def save(folder: str | Path, scene: Objects, frame: Frame | None = None) -> list[Path]:
    """Write object_<id>.npz for each object, and the frame beside them. `farside view` and `load` read these files.

    Raises `OSError` that names the file. A file is written whole or not at all.
    """
    paths = [hypotheses_path(folder, h.object_id) for h in _objects(scene)]
    for path, h in zip(paths, _objects(scene), strict=True):
        save_hypotheses(path, h)
    if frame is not None:
        write_frame_folder(frame_path(folder), frame)
    return paths


def load(path: str | Path) -> Scene:
    """Read a hypotheses file, or all of a folder. Raises `OSError` or `ValueError` that names it."""
    return Scene(tuple(load_scene(path)))


def _objects(scene: Objects) -> Sequence[Hypotheses]:
    return [scene] if isinstance(scene, Hypotheses) else scene
