"""Hypotheses: several complete, weighted shapes of one object, as a planner reads them.

Everything a query needs is here: no prior and no image. Grids follow `probnerf.rendering.occupancy` (G
voxels per axis over the cube, index order [i_x, i_y, i_z], view frame); the object frame of `ObjectFrame` is that frame
in metres.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy.special import entr
from skimage.measure import marching_cubes

from perception.answers.diagnostics import AnswerDiagnostics
from perception.observation.object_frame import ObjectFrame
from probnerf.geometry import rigid
from probnerf.rendering.occupancy import above_plane, solid, voxel_centres, voxel_index, voxel_surface
from probnerf.types import BASE_Z, StopReason

FrameName = Literal["object", "camera", "world"]


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """S weighted shapes of one object seen in one frame."""

    stamp_ns: int  # of the camera frame, ns since the epoch
    frame_id: str  # of the camera's optical frame
    object_id: int
    label: str  # a name for people; may be empty
    object_frame: ObjectFrame
    T_world_camera: Float[np.ndarray, "4 4"] | None  # p_world = T_world_camera @ p_camera, metres
    opacity: UInt8[np.ndarray, "S G G G"]  # round(255 * opacity across the voxel)
    pose: Float[np.ndarray, "S 5"]  # yaw (rad), x, y (cube units), log-scale, z: the canonical shape in the view frame
    weights: Float[np.ndarray, "S"]  # sum 1 (to 1e-6: normalise in f64)
    population: Int[np.ndarray, "S"]  # independent population (or chain) that each hypothesis comes from
    seen: Bool[np.ndarray, "G G G"]  # some camera ray passed through the voxel before its measured end, or ended in it
    inside_view: bool  # False: the object touches the picture's border, so part of it was cut off, not occluded
    out_of_model: bool  # no shape of the prior explains the view: answers turn cautious (`query`)
    stage: int  # of the sampler or controller that these were published after
    monte_carlo_error: float  # standard error of the mean unseen occupancy
    prior_hash: str
    seed: int
    diagnostics: AnswerDiagnostics
    result: StopReason  # the sampler's (`Posterior.result`), or why the controller made no further run
    kinds: Mapping[str, float] = field(default_factory=dict)  # probabilities of what it is (`KINDS`); empty: not known

    def __post_init__(self) -> None:
        shape = self.opacity.shape
        if len(shape) != 4 or len(set(shape[1:])) != 1 or shape[0] < 1 or self.opacity.dtype != np.uint8:
            raise ValueError(f"opacity is {self.opacity.dtype}{list(shape)}; it must be uint8[S, G, G, G] with S >= 1")
        expected = {"pose": (shape[0], 5), "weights": shape[:1], "population": shape[:1], "seen": shape[1:]}
        for name, want in expected.items():
            if (have := getattr(self, name).shape) != want:
                raise ValueError(f"{name} has shape {list(have)}; with this opacity it must be {list(want)}")
        if self.seen.dtype != np.bool_:
            raise ValueError(f"seen is {self.seen.dtype}; it must be bool")
        poses = {"T_camera_object": self.object_frame.T_camera_object, "T_world_camera": self.T_world_camera}
        for name, T in poses.items():
            if T is not None and not (np.shape(T) == (4, 4) and rigid(T)):
                raise ValueError(f"{name} is no rigid transform: {np.asarray(T).tolist()}")
        plane, half_extent = self.object_frame.plane, self.object_frame.half_extent
        if np.shape(plane) != (4,) or not np.isfinite(plane).all():
            raise ValueError(f"plane is {np.asarray(plane).tolist()}; it must be four finite numbers")
        if not 1e-4 <= half_extent <= 1e3:
            raise ValueError(f"half_extent is {half_extent}; it must be 0.0001 to 1000 m")
        if self.kinds and not (min(self.kinds.values()) >= 0 and abs(sum(self.kinds.values()) - 1.0) < 1e-3):
            raise ValueError(f"kinds are {dict(self.kinds)}; they must not be negative and must sum to 1")
        if not np.isfinite(self.pose).all():
            raise ValueError("a pose is not finite")
        if not (np.all(self.weights >= 0) and abs(float(np.sum(self.weights)) - 1.0) < 1e-6):
            raise ValueError(f"weights must not be negative and must sum to 1, not {float(np.sum(self.weights)):.6g}")

    @property
    def grid(self) -> int:
        """Voxels per axis, G."""
        return self.opacity.shape[-1]

    @property
    def voxel_m(self) -> float:
        """Width of a voxel, metres."""
        return 2.0 * self.object_frame.half_extent / self.grid

    @cached_property
    def solid(self) -> Bool[np.ndarray, "S G G G"]:
        """Solid occupancy of each hypothesis (`probnerf.rendering.occupancy.solid`)."""
        return solid(self.opacity, self.base)

    @property
    def base(self) -> Float[np.ndarray, "S"]:
        """Height in the cube on which each hypothesis stands: the plane's height plus the hypothesis's error of it."""
        return BASE_Z + self.pose[:, 4]

    @property
    def unseen(self) -> Bool[np.ndarray, "G G G"]:
        """Space above the support plane that no camera has seen."""
        return ~self.seen & above_plane(self.grid)

    @cached_property
    def p_occupied(self) -> Float[np.ndarray, "G G G"]:
        """Marginal probability that a voxel is occupied; joint questions go to `query`."""
        total = np.zeros(self.seen.shape)
        for weight, shape in zip(self.weights, self.solid, strict=True):
            total += float(weight) * shape
        return np.clip(total, 0.0, 1.0)

    @property
    def disagreement(self) -> Float[np.ndarray, "G G G"]:
        """Binary entropy of `p_occupied` per voxel, nats (0: all hypotheses agree; log 2: evenly split)."""
        return binary_entropy(self.p_occupied)

    @cached_property
    def twins(self) -> Int[np.ndarray, "S"]:
        """For each hypothesis the first one identical to it: resampling copies rows, and a copy is no new evidence."""
        digests = [hashlib.blake2b(row.tobytes()).hexdigest() for row in self.opacity]
        _, first, group = np.unique(digests, return_index=True, return_inverse=True)
        return first[group]

    @property
    def _twin_weight(self) -> Float[np.ndarray, "S"]:
        """Total weight of the hypotheses identical to each."""
        return np.bincount(self.twins, weights=self.weights)[self.twins]

    @property
    def effective_hypotheses(self) -> float:
        """Effective sample size of the weights, identical hypotheses merged: 1 / sum_g W_g^2."""
        return float(1.0 / (self.weights @ self._twin_weight))

    @property
    def failed(self) -> int:
        """How many of the sampler's populations never left a poor mode, and are left out."""
        return int(np.nan_to_num(self.diagnostics.failed_populations))

    @property
    def alone(self) -> bool:
        """All but one of the sampler's populations failed, so the error of the last one is unknown."""
        return self.failed > 0 and len(np.unique(self.population)) == 1

    def estimate(
        self, values: Shaped[np.ndarray, "S ..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Weighted mean m of a quantity over hypotheses and its Monte Carlo standard error.

        se^2 is the larger of two: within, sum_g W_g^2 (x_g - m)^2 over distinct hypotheses g (that of a
        self-normalised weighted mean), and between, the variance of the mean of the P populations' own estimates,
        sum_p (m_p - m')^2 / (P (P - 1)) with m' their average. Populations count equally, independent of their weights:
        if they disagree the answer is uncertain, even if the heaviest is certain.
        """
        x = np.asarray(values, np.float64)
        mean = np.tensordot(self.weights, x, 1)
        within = np.tensordot(self.weights * self._twin_weight, np.square(x - mean), 1)
        own = []
        for p in np.unique(self.population):
            w = np.where(self.population == p, self.weights, 0.0)
            if w.sum() > 0:
                own.append(np.tensordot(w / w.sum(), x, 1))
        between = np.var(own, axis=0, ddof=1) / len(own) if len(own) > 1 else 0.0
        return mean, np.sqrt(np.maximum(within, between))

    def T_object_from(self, frame: FrameName) -> Float[np.ndarray, "4 4"]:
        """p_object = T_object_from(frame) @ p_frame, metres.

        Raises ValueError for an unknown frame, or "world" where the camera's place in the world was not recorded.
        """
        if frame == "object":
            return np.eye(4)
        if frame == "camera":
            return np.linalg.inv(self.object_frame.T_camera_object)
        if frame != "world":
            raise ValueError(f"unknown frame '{frame}': use object, camera or world")
        if self.T_world_camera is None:
            raise ValueError(
                f"object {self.object_id} was recorded without the camera's pose in the world: "
                "ask in the frame object or camera"
            )
        return np.linalg.inv(self.T_world_camera @ self.object_frame.T_camera_object)

    def voxels(
        self, frame: FrameName, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."], z: Float[np.ndarray, "..."]
    ) -> Int[np.ndarray, "..."]:
        """Flat index (C order) of the voxel that holds each point (metres in `frame`), -1 outside this object's cube.

        The coordinates broadcast, so that a lattice is three axes. Raises as `T_object_from`.
        """
        return voxel_index(self.to_cube(frame, x, y, z), self.grid)

    def to_cube(
        self, frame: FrameName, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."], z: Float[np.ndarray, "..."]
    ) -> Float[np.ndarray, "... 3"]:
        """Points (metres in `frame`) in cube units of the object frame. They broadcast; raises as `T_object_from`."""
        T = self.T_object_from(frame)[:3] / self.object_frame.half_extent
        return np.moveaxis(np.stack([a * x + b * y + (c * z + d) for a, b, c, d in T]), 0, -1)


def binary_entropy(p: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """-p log p - (1 - p) log(1 - p), nats."""
    return entr(p) + entr(1.0 - p)


def by_weight(hypotheses: Hypotheses) -> Int[np.ndarray, "D"]:
    """Indices of the distinct hypotheses, heaviest first, the weights of identical ones added (ties in order)."""
    total = np.bincount(hypotheses.twins, weights=hypotheses.weights)
    distinct = np.unique(hypotheses.twins)
    return distinct[np.argsort(-total[distinct], kind="stable")]


def meshes(hypotheses: Hypotheses, k: int) -> list[tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]]:
    """`mesh` of the k heaviest distinct hypotheses."""
    return [mesh(hypotheses, index) for index in by_weight(hypotheses)[:k]]


def mesh(hypotheses: Hypotheses, index: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Closed outer surface of one hypothesis: (vertices in metres in the object frame, triangles).

    Triangles turn counter-clockwise seen from outside; an empty shape has no vertices.
    """
    occupied = hypotheses.solid[index]
    if not occupied.any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    # The walls' opacity places the surface between voxels. Every solid voxel is above the level, so that no inner wall
    # is drawn.
    opacity = hypotheses.opacity[index]
    level = np.where(occupied, np.maximum(opacity, 128), np.minimum(opacity, 127)).astype(np.float32)
    level[..., voxel_centres(hypotheses.grid)[0, 0, :, 2] < min(hypotheses.base[index], BASE_Z)] = 0.0
    # With axes in the order x, y, z its "ascent" is what turns triangles counter-clockwise about a full inside.
    vertices, faces, _, _ = marching_cubes(np.pad(level, 1), 127.5, gradient_direction="ascent")
    cube = -1.0 + (vertices.astype(np.float64) - 0.5) * 2.0 / hypotheses.grid  # one voxel of padding
    return cube * hypotheses.object_frame.half_extent, faces.astype(np.int32)


def surface_points(hypotheses: Hypotheses, index: int) -> Float[np.ndarray, "n 3"]:
    """Centres of the exposed voxel faces of one hypothesis, metres in the object frame."""
    return voxel_surface(hypotheses.solid[index]) * hypotheses.object_frame.half_extent
