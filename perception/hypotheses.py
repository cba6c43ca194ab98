"""Hypotheses: several whole weighted shapes of one object, as a planner reads them, and the file that keeps them.

Everything a query needs is here: no prior and no image. Grids follow `probnerf.occupancy` (G voxels per axis over the
cube, index order [i_x, i_y, i_z], view frame); the object frame of `ObjectFrame` is that frame in metres.

The file is a NumPy `.npz` without pickles. `header` holds the UTF-8 bytes of a JSON object with `format` and the scalar
fields of `Hypotheses` and of its ObjectFrame by their own names; the arrays `opacity`, `pose`, `weights`, `population`,
`seen`, `T_camera_object`, `plane` and, where it is known, `T_world_camera` are the fields of those names. Equal content
gives equal bytes.
"""

import hashlib
import json
import os
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy.special import entr
from skimage.measure import marching_cubes

from perception.observe import ObjectFrame
from probnerf.occupancy import solid, voxel_centres, voxel_index, voxel_surface
from probnerf.types import BASE_Z

FORMAT = "farside-hypotheses-"
VERSION = 1

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
    pose: Float[np.ndarray, "S 4"]  # yaw (rad), x, y (cube units), log-scale: the canonical shape in the view frame
    weights: Float[np.ndarray, "S"]  # sum 1 (to 1e-6: normalise in f64)
    population: Int[np.ndarray, "S"]  # independent population (or chain) that each hypothesis comes from
    seen: Bool[np.ndarray, "G G G"]  # some camera ray passed through the voxel before its measured end, or ended in it
    inside_view: bool  # False: the object touches the picture's border, so part of it was cut off, not occluded
    out_of_model: bool  # no shape of the prior explains the view: answers turn cautious (`query`)
    stage: int  # of the sampler or controller that these were published after
    monte_carlo_error: float  # standard error of the mean unseen occupancy
    prior_hash: str
    seed: int
    diagnostics: dict[str, float]
    result: str  # why sampling stopped: "converged", "budget", "stages", "interrupted"

    def __post_init__(self) -> None:
        shape = self.opacity.shape
        if len(shape) != 4 or len(set(shape[1:])) != 1 or shape[0] < 1 or self.opacity.dtype != np.uint8:
            raise ValueError(f"opacity is {self.opacity.dtype}{list(shape)}; it must be uint8[S, G, G, G] with S >= 1")
        expected = {"pose": (shape[0], 4), "weights": shape[:1], "population": shape[:1], "seen": shape[1:]}
        for name, want in expected.items():
            if (have := getattr(self, name).shape) != want:
                raise ValueError(f"{name} has shape {list(have)}; with this opacity it must be {list(want)}")
        if self.seen.dtype != np.bool_:
            raise ValueError(f"seen is {self.seen.dtype}; it must be bool")
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
        """Solid occupancy of each hypothesis (`probnerf.occupancy.solid`)."""
        return solid(self.opacity)

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

    def estimate(
        self, values: Shaped[np.ndarray, "S ..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Weighted mean m of a quantity over hypotheses and its Monte Carlo standard error.

        se^2 is the larger of two: within, sum_g W_g^2 (x_g - m)^2 over distinct hypotheses g (that of a
        self-normalised weighted mean), and between, the variance of the mean of the P populations' own estimates,
        sum_p (m_p - m')^2 / (P (P - 1)) with m' their average. A population counts equally whatever its weight: where
        populations disagree the answer is uncertain, however sure the heaviest is.
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
        T = self.T_object_from(frame)[:3] / self.object_frame.half_extent
        cube = np.stack([a * x + b * y + (c * z + d) for a, b, c, d in T])
        return voxel_index(np.moveaxis(cube, 0, -1), self.grid)


def binary_entropy(p: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """-p log p - (1 - p) log(1 - p), nats."""
    return entr(p) + entr(1.0 - p)


def by_weight(hypotheses: Hypotheses) -> Int[np.ndarray, "D"]:
    """Indices of the distinct hypotheses, heaviest first, the weights of identical ones added (ties in order)."""
    total = np.bincount(hypotheses.twins, weights=hypotheses.weights)
    distinct = np.unique(hypotheses.twins)
    return distinct[np.argsort(-total[distinct], kind="stable")]


def meshes(hypotheses: Hypotheses, k: int) -> list[tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]]:
    """Closed outer surfaces of the k heaviest distinct hypotheses: (vertices in metres in the object frame, triangles).

    Triangles turn counter-clockwise seen from outside; an empty shape has no vertices.
    """
    out = []
    for index in by_weight(hypotheses)[:k]:
        occupied = hypotheses.solid[index]
        if not occupied.any():
            out.append((np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
            continue
        # The walls' own opacity places the surface between voxels; all that is solid lies above the level, so that no
        # inner wall is drawn.
        opacity = hypotheses.opacity[index]
        level = np.where(occupied, np.maximum(opacity, 128), np.minimum(opacity, 127)).astype(np.float32)
        level[..., voxel_centres(hypotheses.grid)[0, 0, :, 2] < BASE_Z] = 0.0
        # With axes in the order x, y, z its "ascent" is what turns triangles counter-clockwise about a full inside.
        vertices, faces, _, _ = marching_cubes(np.pad(level, 1), 127.5, gradient_direction="ascent")
        cube = -1.0 + (vertices.astype(np.float64) - 0.5) * 2.0 / hypotheses.grid  # one voxel of padding
        out.append((cube * hypotheses.object_frame.half_extent, faces.astype(np.int32)))
    return out


def surface_points(hypotheses: Hypotheses, index: int) -> Float[np.ndarray, "n 3"]:
    """Centres of the exposed voxel faces of one hypothesis, metres in the object frame."""
    return voxel_surface(hypotheses.solid[index]) * hypotheses.object_frame.half_extent


def hypotheses_path(folder: str | Path, object_id: int) -> Path:
    """Where one object's hypotheses lie in a folder; the folder is joint over all its objects."""
    return Path(folder) / f"object_{object_id}.npz"


def save(path: str | Path, hypotheses: Hypotheses) -> None:
    """Write the file whole or not at all (a temporary file beside it, then a rename)."""
    h, path = hypotheses, Path(path)
    header = {
        "format": f"{FORMAT}{VERSION}",
        "stamp_ns": int(h.stamp_ns),
        "frame_id": h.frame_id,
        "object_id": int(h.object_id),
        "label": h.label,
        "half_extent": float(h.object_frame.half_extent),
        "xy_sigma": float(h.object_frame.xy_sigma),
        "log_scale_sigma": float(h.object_frame.log_scale_sigma),
        "inside_view": bool(h.inside_view),
        "out_of_model": bool(h.out_of_model),
        "stage": int(h.stage),
        "monte_carlo_error": float(h.monte_carlo_error),
        "prior_hash": h.prior_hash,
        "seed": int(h.seed),
        "diagnostics": {name: float(value) for name, value in h.diagnostics.items()},
        "result": h.result,
    }
    arrays = {
        "header": np.frombuffer(json.dumps(header, sort_keys=True).encode(), np.uint8),
        "opacity": h.opacity,
        "pose": np.asarray(h.pose, np.float32),
        "weights": np.asarray(h.weights, np.float64),
        "population": np.asarray(h.population, np.int32),
        "seen": np.asarray(h.seen, bool),
        "T_camera_object": np.asarray(h.object_frame.T_camera_object, np.float64),
        "plane": np.asarray(h.object_frame.plane, np.float64),
    }
    if h.T_world_camera is not None:
        arrays["T_world_camera"] = np.asarray(h.T_world_camera, np.float64)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        # Not np.savez_compressed, whose level of compression takes six times as long for a seventh less. Members opened
        # by name carry zip's zero date, so that equal content gives equal bytes.
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load(path: str | Path) -> Hypotheses:
    """Read a hypotheses file.

    Raises FileNotFoundError, or ValueError with one line for a file of another kind, one cut short or damaged, and one
    written by a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; `farside replay` writes hypotheses files")
    if not zipfile.is_zipfile(path):  # the table of contents stands at a zip file's end
        with path.open("rb") as file:
            cut = file.read(4) == b"PK\x03\x04"
        raise ValueError(
            f"{path} is cut short at byte {path.stat().st_size}; write it again with `farside replay`"
            if cut
            else f"{path} is not a hypotheses file; give one that `farside replay` wrote"
        )
    damaged = f"{path} is damaged ({{}}); write it again with `farside replay`"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ValueError(damaged.format(error)) from error
    header = _header(path, arrays)
    try:
        return _from_file(header, arrays)
    except KeyError as error:
        raise ValueError(damaged.format(f"it has no field {error}")) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(damaged.format(error)) from error


def load_scene(path: str | Path) -> list[Hypotheses]:
    """A hypotheses file, or all objects' files in a folder that `farside replay` wrote, by object id."""
    path = Path(path)
    if not path.is_dir():
        return [load(path)]
    files = sorted(path.glob("object_*.npz"))
    if not files:
        raise FileNotFoundError(f"{path} holds no object_<id>.npz; give a folder that `farside replay` wrote")
    return sorted((load(file) for file in files), key=lambda h: h.object_id)


def _header(path: Path, arrays: dict[str, np.ndarray]) -> dict:
    """The JSON header, its format checked."""
    try:
        header = json.loads(arrays["header"].tobytes())
        name = header["format"]
        prefix, version = name[: len(FORMAT)], int(name[len(FORMAT) :])
    except (AttributeError, KeyError, TypeError, ValueError):
        prefix, version = "", 0
    if prefix != FORMAT:
        raise ValueError(f"{path} is not a hypotheses file; give one that `farside replay` wrote")
    if version > VERSION:
        raise ValueError(f"{path} has format {name}, newer than this Farside reads ({FORMAT}{VERSION}): update Farside")
    return header


def _from_file(header: dict, arrays: dict[str, np.ndarray]) -> Hypotheses:
    """The inverse of `save`; raises KeyError for a missing field."""
    frame = ObjectFrame(
        T_camera_object=arrays["T_camera_object"],
        half_extent=header["half_extent"],
        plane=arrays["plane"],
        xy_sigma=header["xy_sigma"],
        log_scale_sigma=header["log_scale_sigma"],
    )
    return Hypotheses(
        stamp_ns=header["stamp_ns"],
        frame_id=header["frame_id"],
        object_id=header["object_id"],
        label=header["label"],
        object_frame=frame,
        T_world_camera=arrays.get("T_world_camera"),
        opacity=arrays["opacity"],
        pose=arrays["pose"],
        weights=arrays["weights"],
        population=arrays["population"],
        seen=arrays["seen"],
        inside_view=header["inside_view"],
        out_of_model=header["out_of_model"],
        stage=header["stage"],
        monte_carlo_error=header["monte_carlo_error"],
        prior_hash=header["prior_hash"],
        seed=header["seed"],
        diagnostics=header["diagnostics"],
        result=header["result"],
    )
