"""Sensors as they are sold, and planes as they are measured, drawn at random: for training and for tests of robustness.

The ranges are priors: each has its reason beside it. They are wider than one data sheet, because a user's sensor is
none of those that anyone measured.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.observation.segmentation import Segment
from perception.observation.settings import PlaneGuess
from perception.observation.support_plane import horizontal
from perception.simulation.sensor_faults import SensorConfig

Kind = Literal["structured light", "active stereo", "time of flight"]
KINDS: tuple[Kind, ...] = ("structured light", "active stereo", "time of flight")


@dataclass(frozen=True)
class PlaneErrorConfig:
    """How far the plane under an object is measured beside the true one.

    A table and what stands on it are seen at different angles and brightness, so their depths have different biases.
    On real frames the plane is 5 to 10 mm off where it is off.
    """

    offset_sigma: float = 0.004  # m, at the object's foot
    offset_most: float = 0.010  # m
    tilt_sigma: float = 0.4  # degrees; 1 degree over 30 cm of table is 5 mm
    tilt_most: float = 1.0  # degrees


def draw_sensor(rng: np.random.Generator, kind: Kind | None = None) -> SensorConfig:
    """A realistic depth camera; of the given kind, or of a random one."""
    kind = kind or KINDS[rng.integers(len(KINDS))]
    side = rng.choice([-1.0, 1.0])  # cameras are mounted either way up, and vendors put the colour eye on either side
    stereo = kind == "active stereo"
    if kind == "structured light":
        # PrimeSense, Orbbec: sigma = 1.4 mm z^2, quantum 2.8 mm z^2 (Khoshelham and Elberink 2012); at 0.3 to 1 m.
        own = SensorConfig(
            noise=rng.uniform(0.0003, 0.001),
            noise_z2=rng.uniform(0.001, 0.003),
            noise_width=rng.uniform(0.8, 2.0),  # windows of 9 px share most of their dots
            quantum=rng.choice([0.0005, 0.001, 0.002]),
            baseline=side * rng.uniform(0.04, 0.08),
            flying=rng.uniform(0.1, 0.4),  # matching refuses most of them
            fattening=int(rng.integers(0, 3)),
            cavity=rng.uniform(0.0, 0.5),  # reflected dots blur the code
            smoothing=rng.uniform(0.0, 1.0),
        )
    elif stereo:
        # RealSense D400, OAK-D Pro: 0.05 to 0.15 px of disparity, so z^2 times that over focal length and baseline.
        own = SensorConfig(
            noise=rng.uniform(0.0003, 0.0015),
            noise_z2=rng.uniform(0.0015, 0.006),
            noise_width=rng.uniform(0.6, 2.5),
            quantum=rng.choice([0.0001, 0.001]),
            baseline=side * rng.uniform(0.04, 0.10),  # 50 mm D435, 55 mm D415, 75 mm OAK-D, 95 mm D455
            flying=rng.uniform(0.2, 0.7),
            fattening=int(rng.integers(0, 5)),  # half a census window of 5 to 9 px
            cavity=rng.uniform(0.0, 0.6),  # no texture inside: the surroundings' disparity is carried in
            smoothing=rng.uniform(0.0, 2.0) * (rng.random() < 0.5),  # the spatial filter is the user's choice
        )
    else:
        # Azure Kinect, L515, ToF industrial cameras: little noise, many mixed pixels, multi-path in concave things.
        own = SensorConfig(
            noise=rng.uniform(0.0005, 0.003),
            noise_z2=rng.uniform(0.0, 0.002),
            noise_width=rng.uniform(0.4, 1.0),  # each pixel measures for itself
            quantum=0.001,
            baseline=side * rng.uniform(0.0, 0.02),  # the emitter sits beside the lens
            flying=rng.uniform(0.4, 0.9),  # a pixel's phase is the sum of both surfaces
            cavity=rng.uniform(0.2, 1.0),
            smoothing=rng.uniform(0.0, 1.0),
        )
    triangulates = kind != "time of flight"
    return replace(
        own,
        # Azure Kinect: below 11 mm + 0.1%; RealSense: below 2% at 2 m. Triangulation errs with z^2 (a shifted baseline
        # or disparity), time of flight by a constant.
        bias=(
            rng.normal(0.0, 0.001 if triangulates else 0.003),
            rng.normal(0.0, 0.003),
            rng.normal(0.0, 0.004 if triangulates else 0.001),
        ),
        grazing=rng.uniform(72.0, 84.0),
        blobs=10.0 ** rng.uniform(-5.0, -3.5),
        blob_radius=rng.uniform(1.0, 4.0),
        dark=rng.uniform(0.02, 0.15) * (rng.random() < 0.7),  # black plastic returns 2 to 5% of the light
        shiny=rng.uniform(3.0, 15.0) * (rng.random() < 0.6),  # lobes of glazed ceramics to satin metal
        cavity_lost=rng.uniform(0.0, 0.6) * (rng.random() < 0.6),
        rim_lost=rng.uniform(0.0, 0.7),
        rim=int(rng.integers(1, 4)),
        registration=_registration(rng),
        colour_noise=rng.uniform(0.002, 0.02),
        patch=rng.uniform(0.7, 3.0),
    )


def _registration(rng: np.random.Generator) -> tuple[float, float]:
    """A calibration's rms of 0.3 to 0.5 px, an eye that warmed up, or two eyes that expose one after the other."""
    right, down = np.clip(rng.normal(0.0, 0.5, 2), -1.2, 1.2)
    return float(right), float(down)


def mistaken_plane(
    plane: Float[np.ndarray, "4"],
    at: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    config: PlaneErrorConfig | None = None,
) -> Float[np.ndarray, "4"]:
    """A measured plane (n, d), moved and tilted about the point `at` (camera frame, m) as a sensor's bias does.

    The offset is N(0, offset_sigma) and the tilt, about a random level axis, the size of N(0, tilt_sigma); both are cut
    off at their most.
    """
    config = config or PlaneErrorConfig()
    offset = float(np.clip(rng.normal(0.0, config.offset_sigma), -config.offset_most, config.offset_most))
    tilt = np.radians(min(abs(rng.normal(0.0, config.tilt_sigma)), config.tilt_most))
    turn = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(turn), np.sin(turn)]) @ horizontal(plane)
    normal = Rotation.from_rotvec(tilt * axis).apply(plane[:3])
    height = float(at @ plane[:3] + plane[3])  # of `at`: the plane turns about the point below it
    foot = at - height * plane[:3]
    return np.append(normal, -normal @ foot - offset)


def on_mistaken_plane(
    segment: Segment,
    at: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    config: PlaneErrorConfig | None = None,
) -> Segment:
    """The segment with its plane mistaken, for `object_frame`, `observe` and `crop` to take in place of the measured.

    Statuses stay: the table's own pixels lie on the plane that they gave, however wrong it is below the object.
    """
    return replace(segment, plane=mistaken_plane(segment.plane, at, rng, config))


def told_pose(
    T_world_camera: Float[np.ndarray, "4 4"], rng: np.random.Generator, stated: PlaneGuess | None = None
) -> Float[np.ndarray, "4 4"]:
    """A camera's pose over the table as its user tells it: height and tilt err by what `PlaneGuess` states."""
    stated = stated or PlaneGuess()
    T_told = T_world_camera.copy()
    T_told[2, 3] += rng.normal(0.0, stated.height_sigma)
    T_told[:3, :3] @= Rotation.from_euler("x", rng.normal(0.0, stated.tilt_sigma), degrees=True).as_matrix()
    return T_told
