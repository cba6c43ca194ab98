"""Examples to train a posterior network on: the picture that perception cuts out of a frame, and where the object is.

Every example goes through perception's own code, from the frame on. What perception refuses is no example; its reasons
are counted.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from perception.observation.encoder_crop import crop
from perception.observation.object_frame import ObjectFrame, object_frame
from perception.observation.rays import pose_widths
from perception.observation.segmentation import Segment, segment
from perception.observation.settings import ObserveConfig, SegmentConfig
from perception.simulation.mesh_scene import MeshShape, PlacedMesh, render_meshes
from perception.simulation.sensor_draws import draw_sensor, on_mistaken_plane, told_pose
from perception.simulation.sensor_faults import sense
from perception.simulation.view_draws import ViewDraws, draw_view
from perception.sources.frame import Frame
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.types import BASE_Z, POSE_SIZE

_WINDOW = SegmentConfig(whole=False)  # pictures are windows of larger ones
_SAME = 0.5  # intersection over union with the true mask from which a segment is the object


@dataclass(frozen=True, eq=False)
class Example:
    """What a network is given, and the truth in the sampler's units."""

    picture: EncoderPicture  # NumPy leaves
    pose_sigma: Float[np.ndarray, "5"]  # as in `Observation`
    pose: Float[np.ndarray, "7"]  # a, b (on the unit circle), x, y, log-scale, range offset, z: divided by their sigmas
    cube: ObjectFrame
    half_extent: float  # m per canonical cube unit
    depth: bool
    pose_known: bool


@dataclass(frozen=True)
class ExampleDraws:
    """How frames become examples: probabilities."""

    no_depth: float = 0.15
    own_mask: float = 0.3  # with depth: perception finds the object itself, instead of the true mask
    wrong_plane: float = 0.5  # with depth: the plane is mistaken (`PlaneErrorConfig`)
    pose_known: float = 0.1


def example_of(
    frame: Frame,
    placed: PlacedMesh,
    size: int,
    rng: np.random.Generator,
    *,
    true_depth: Float[np.ndarray, "h w"] | None = None,
    own_mask: bool = False,
    wrong_plane: bool = False,
    pose_known: bool = False,
    object_id: int = 1,
    config: ObserveConfig | None = None,
) -> Example | str:
    """The example of a frame with the true label map and T_world_camera, or why perception refuses it.

    Without depth in the frame perception is told the camera's pose with an error (`told_pose`). Of the network's target
    then only what the sampler samples is asked: the error along the line of sight that place and size share
    (`ObjectFrame.sight_sigma`) is drawn from its posterior given the true pose, and taken out.
    `true_depth` (m along z) tells the range offset; without it the target's is 0.
    """
    config = config or ObserveConfig()
    assert frame.T_world_camera is not None and frame.label is not None
    T_camera_object = np.linalg.inv(frame.T_world_camera) @ placed.T_world_object
    seen = frame if frame.depth is not None else replace(frame, T_world_camera=told_pose(frame.T_world_camera, rng))
    try:
        found = (
            _found(seen, object_id) if own_mask and frame.depth is not None else segment(seen, object_id, _WINDOW)[0]
        )
        if wrong_plane and frame.depth is not None:
            found = on_mistaken_plane(found, T_camera_object[:3, 3], rng)
        if pose_known:
            cube = ObjectFrame(T_camera_object, placed.half_extent, found.plane, 0.0, 0.0)
        else:
            cube = object_frame(seen, found, config)
    except ValueError as error:
        return str(error)
    picture = crop(seen, found, cube, size)
    host: dict[str, Any] = {name: np.asarray(value) for name, value in vars(picture).items()}
    pose_sigma = pose_widths(frame.camera, cube, config)
    offset = 0.0 if true_depth is None else _range_offset(frame, found, true_depth) / cube.half_extent
    return Example(
        picture=EncoderPicture(**host),
        pose_sigma=pose_sigma,
        pose=_position(cube, T_camera_object, placed.half_extent, offset, pose_sigma, rng),
        cube=cube,
        half_extent=placed.half_extent,
        depth=frame.depth is not None,
        pose_known=pose_known,
    )


def draw_example(
    rng: np.random.Generator,
    shape: MeshShape,
    others: Sequence[MeshShape],
    size: int,
    draws: ExampleDraws | None = None,
    views: ViewDraws | None = None,
) -> Example | str:
    """A random view of a shape through a random sensor, as an example; or why perception refuses it."""
    draws = draws or ExampleDraws()
    view = draw_view(rng, shape, others, views)
    picture = render_meshes(view.scene, view.camera, view.T_world_camera)
    frame = sense(picture, view.camera, view.T_world_camera, int(rng.integers(1 << 31)), draw_sensor(rng))
    if not (picture.label == 1).any():
        return "no pixel shows the object"
    without, own, wrong, known = rng.random(4) < (draws.no_depth, draws.own_mask, draws.wrong_plane, draws.pose_known)
    return example_of(
        replace(frame, depth=None) if without else frame,
        view.target,
        size,
        rng,
        true_depth=picture.depth,
        own_mask=bool(own),
        wrong_plane=bool(wrong),
        pose_known=bool(known),
    )


def draw_examples(
    seeds: Iterable[int],
    shapes: Sequence[MeshShape],
    size: int,
    draws: ExampleDraws | None = None,
    views: ViewDraws | None = None,
) -> tuple[list[Example], Counter[str]]:
    """An example for each seed, of a random shape among the others, and how often perception refused for which reason.

    Numbers in reasons read #, so that equal ones count together.
    """
    examples, reasons = [], Counter[str]()
    for seed in seeds:
        rng = np.random.default_rng([seed, 67])
        drawn = draw_example(rng, shapes[int(rng.integers(len(shapes)))], shapes, size, draws, views)
        if isinstance(drawn, Example):
            examples.append(drawn)
        else:
            reasons[re.sub(r"\d+(\.\d+)?", "#", drawn)] += 1
    return examples, reasons


def _found(frame: Frame, object_id: int) -> Segment:
    """Perception's own segment of a labelled object. Raises `ValueError` where it finds none."""
    assert frame.label is not None
    true = frame.label == object_id
    segments = segment(replace(frame, label=None), config=_WINDOW)
    overlap = [(s.mask & true).sum() / (s.mask | true).sum() for s in segments]
    if max(overlap) < _SAME:
        raise ValueError("perception's own segments miss the object or join it with others")
    return segments[int(np.argmax(overlap))]


def _range_offset(frame: Frame, found: Segment, true_depth: Float[np.ndarray, "h w"]) -> float:
    """The median error of the object's measured ranges, m."""
    if frame.depth is None:
        return 0.0
    v, u = np.nonzero(found.mask & np.isfinite(frame.depth) & np.isfinite(true_depth))
    if not len(v):
        return 0.0
    along = frame.camera.rays(np.column_stack([u, v]))[:, 2]
    return float(np.median((frame.depth[v, u] - true_depth[v, u]) / along))


def _position(
    cube: ObjectFrame,
    T_camera_object: Float[np.ndarray, "4 4"],
    half_extent: float,
    offset: float,
    pose_sigma: Float[np.ndarray, "5"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "7"]:
    """The canonical object's pose in the cube, in the order and units of a position (`probnerf.likelihood.position`).

    A tilt between both ups, which a mistaken plane makes, has no entry: the nearest turn about the vertical is given.
    """
    T = np.linalg.inv(cube.T_camera_object) @ T_camera_object
    yaw = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    foot = (T[:3, :3] @ [0.0, 0.0, BASE_Z * half_extent] + T[:3, 3]) / cube.half_extent
    log_scale = np.log(half_extent / cube.half_extent)
    if cube.sight_sigma > 0:  # p -> camera + (p - camera) / exp(error), as `shapes.scaled_about` undoes it
        camera = cube.to_cube(np.zeros(3))
        distance = float(np.linalg.norm(camera))
        total = np.log(np.linalg.norm(foot - camera) / np.linalg.norm(camera - [0.0, 0.0, BASE_Z]))
        shared, rest = cube.sight_sigma**2, (pose_sigma[0] / distance) ** 2
        error = total * shared / (shared + rest) + rng.normal(0.0, np.sqrt(shared * rest / (shared + rest)))
        foot, log_scale = camera + (foot - camera) * np.exp(-error), log_scale - error
    moved = np.array([foot[0], foot[1], log_scale, offset, foot[2] - BASE_Z])
    pose = np.zeros(POSE_SIZE)
    pose[:2] = np.cos(yaw), np.sin(yaw)
    pose[2:] = moved / np.maximum(pose_sigma, 1e-9)
    return pose
