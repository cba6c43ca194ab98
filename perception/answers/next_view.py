"""Next views: candidate cameras ranked by how well their picture would tell the hypotheses apart.

A camera at v would measure ranges y. With the hypotheses as the prior (weights w_s), the expected information gain is
the mutual information I(S; Y_v) between the true shape and the picture. For a mixture it has no closed form; the
pairwise-distance estimator (Kolchinsky and Tracey, Entropy 19(7):361, 2017, eq. 10)

    I = -sum_s w_s log sum_r w_r exp(-C(p_s, p_r)),    C the Bhattacharyya distance of the two pictures' laws,

is a lower bound, exact if the pictures are equal or completely distinct, and lies in [0, H(S)]. Several objects are
independent given the frame: their gains add. Occlusion between objects is ignored.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt64

from perception.answers.hypotheses import Hypotheses
from perception.answers.query import check_one_frame
from probnerf.geometry import look_at, pinhole_rays, rigid
from probnerf.rendering.voxel_rays import met

_HALF = 1.1  # cube units that a picture shows on each side of the cube's centre


@dataclass(frozen=True)
class NextViewConfig:
    """The candidate views, and the model of one pixel's information."""

    azimuths: int = 12
    elevations: tuple[float, ...] = (20.0, 45.0, 70.0)  # degrees above the support plane
    pixels: int = 12  # per side, over the cube; their ranges represent the whole picture's
    wall_sigma: float = 0.05  # cube units; standard deviation of a range between model and camera
    mask_error: float = 0.01  # probability that object and background are confused in a pixel
    power: float = 0.5  # pixels' errors are not independent: largest weight of each pixel
    present: float = 0.25  # mean distance of the hypotheses' pictures in the present view, whose information is used up


@dataclass(frozen=True, eq=False)
class RankedViews:
    """Camera poses, best first. p_object = T_object_camera @ p_camera (m), in the first object's frame."""

    T_object_camera: Float[np.ndarray, "c 4 4"]
    gain_nats: Float[np.ndarray, "c"]  # expected information gain about which hypotheses are true
    entropy_nats: float  # of the hypotheses' weights: no view can gain more


def rank_views(
    scene: Sequence[Hypotheses],
    cameras: Float[np.ndarray, "c 4 4"] | None = None,
    count: int = 5,
    config: NextViewConfig | None = None,
) -> RankedViews:
    """The `count` best of `cameras` (T_object_camera in the first object's frame, metres; None: `ring_of_views`).

    Raises ValueError for an empty scene, objects of different frames, cameras that are no rigid transforms, and a
    camera at the centre of an object's cube.
    """
    config = config or NextViewConfig()
    check_one_frame(scene)
    first = scene[0]
    T = ring_of_views(first, config) if cameras is None else np.asarray(cameras, np.float64)
    _check_rigid(T)
    gain, entropy = np.zeros(len(T)), 0.0
    for h in scene:
        T_own = np.linalg.inv(h.object_frame.T_camera_object) @ first.object_frame.T_camera_object @ T
        distance = np.linalg.norm(T_own[:, :3, 3], axis=1)
        if (inside := distance < 1e-3 * h.object_frame.half_extent).any():
            row = int(np.flatnonzero(inside)[0])
            raise ValueError(
                f"candidate camera {row + 1} is at the centre of object {h.object_id}; give one outside it"
            )
        gain += _gains(h, T_own, config)
        w = np.bincount(h.twins, weights=h.weights)
        entropy -= float(np.sum(w[w > 0] * np.log(w[w > 0])))
    best = np.argsort(-gain, kind="stable")[: max(count, 0)]
    return RankedViews(T[best], gain[best], entropy)


def ring_of_views(h: Hypotheses, config: NextViewConfig | None = None) -> Float[np.ndarray, "c 4 4"]:
    """Cameras around the object at the present camera's distance that look at its cube's centre (T_object_camera, m).

    Azimuth 0 is the present camera's side.
    """
    config = config or NextViewConfig()
    at = np.linalg.inv(h.object_frame.T_camera_object)[:3, 3]
    distance = float(np.linalg.norm(at))
    views = []
    for elevation in np.radians(config.elevations):
        for azimuth in 2.0 * np.pi * np.arange(config.azimuths) / config.azimuths:
            towards = (math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation))
            place = distance * np.array([*towards, math.sin(elevation)])
            views.append(look_at(place, np.zeros(3)).astype(np.float64))
    return np.stack(views)


def _check_rigid(T: Float[np.ndarray, "c 4 4"]) -> None:
    if T.ndim != 3 or T.shape[1:] != (4, 4) or not len(T):
        raise ValueError(f"candidate cameras have shape {list(T.shape)}; give [c, 4, 4] with c >= 1")
    if not (fine := rigid(T)).all():
        row = int(np.flatnonzero(~fine)[0])
        raise ValueError(
            f"candidate camera {row} is no rigid transform: {T[row].tolist()}; give T_object_camera in metres"
        )


def _gains(
    h: Hypotheses, T_object_camera: Float[np.ndarray, "c 4 4"], config: NextViewConfig
) -> Float[np.ndarray, "c"]:
    """I(S; Y) of one object and each camera, nats (the module's equation).

    All hypotheses explain the present view, and another picture from there would share its errors. So its distances
    are those of samples that it cannot distinguish. They are the unit for distances in other views.
    """
    words = packed(h.solid)
    present = np.linalg.inv(h.object_frame.T_camera_object)
    w = h.weights
    unit = float(w @ _distances(h, words, present, config) @ w)
    power = min(config.power, config.present / max(unit, 1e-9))
    gains = []
    for T in T_object_camera:
        mixed = np.exp(-power * _distances(h, words, T, config)) @ w
        gains.append(max(0.0, -float(w @ np.log(np.maximum(mixed, 1e-300)))))
    return np.array(gains)


def _distances(
    h: Hypotheses,
    words: list[UInt64[np.ndarray, "g g g"]],
    T_object_camera: Float[np.ndarray, "4 4"],
    config: NextViewConfig,
) -> Float[np.ndarray, "S S"]:
    """Bhattacharyya distance between the hypotheses' range pictures, summed over pixels as if these were independent.

    A pixel: (d_s - d_r)^2 / (8 sigma^2) where both hit, that of two Bernoulli laws where one does; never above it.
    """
    at = T_object_camera[:3, 3] / h.object_frame.half_extent
    distance = max(float(np.linalg.norm(at)), 1e-6)
    T = look_at(at, np.zeros(3))  # every camera is rotated to have the object in the picture's middle
    _, directions = pinhole_rays(T, 0.5 * config.pixels * distance / _HALF, config.pixels)
    ranges = first_hits(words, len(h.weights), T[:3, 3], directions)
    ranges = ranges[np.isfinite(ranges).any(axis=1)]
    hit, depth = np.isfinite(ranges), np.nan_to_num(ranges, posinf=0.0)
    most = -math.log(2.0 * math.sqrt(config.mask_error * (1.0 - config.mask_error)))
    apart = np.minimum((depth[:, :, None] - depth[:, None]) ** 2 / (8.0 * config.wall_sigma**2), most)
    apart = np.where(hit[:, :, None] & hit[:, None], apart, most * (hit[:, :, None] ^ hit[:, None]))
    return apart.sum(axis=0, dtype=np.float64)


def first_hits(
    words: list[UInt64[np.ndarray, "g g g"]],
    count: int,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n S"]:
    """Distance (cube units, to a voxel) along each ray to each of `count` shapes (`packed`); infinite: missed."""
    ranges = np.full((len(directions), count), np.inf, np.float32)
    for start, word in enumerate(words):
        for rays, t, held in met(word, origin, directions, 1.0, first=0.5):
            before = np.bitwise_or.accumulate(held, axis=1)
            held[:, 1:] &= ~before[:, :-1]  # the shapes that the ray meets here for the first time
            ray, at = np.nonzero(held)
            for bit in range(min(64, count - 64 * start)):
                first = (held[ray, at] >> np.uint64(bit)) & np.uint64(1) == 1
                ranges[rays[ray[first]], 64 * start + bit] = t[ray[first], at[first]]
    return ranges


def packed(solid: Bool[np.ndarray, "S G G G"]) -> list[UInt64[np.ndarray, "g g g"]]:
    """The shapes that fill each voxel, as bits of 64 each: one look-up serves all. With a border, for `met`."""
    words = []
    for start in range(0, len(solid), 64):
        word = np.zeros(solid.shape[1:], np.uint64)
        for bit, shape in enumerate(solid[start : start + 64]):
            word |= shape.astype(np.uint64) << np.uint64(bit)
        words.append(np.pad(word, 1))
    return words
