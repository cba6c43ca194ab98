"""Exact RGB-D pictures of upright cylinders on a round table, with a sensor's noise. World: z up, table at z = 0."""

from dataclasses import dataclass

import numpy as np

from calibration.camera import Camera
from perception.sources.frame import Frame

CAMERA = Camera(320, 240, np.array([[310.0, 0.0, 159.5], [0.0, 310.0, 119.5], [0.0, 0.0, 1.0]]), np.zeros(5))
TABLE_RADIUS, FLOOR, WALL = 0.45, -0.7, 1.6  # m
WALL_THICKNESS = 0.003  # m


@dataclass(frozen=True)
class Cylinder:
    x: float  # m, world
    y: float
    radius: float
    height: float
    base: float = 0.0
    is_open: bool = False  # a cup: a wall and a floor, WALL_THICKNESS each


CAN = Cylinder(0.0, 0.0, 0.045, 0.12)


def looking_down(degrees: float = 35.0, distance: float = 0.7, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """T_world_camera of a camera at y < 0 that looks along +y and down at the table."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, -s, c], [0.0, -c, -s]])
    T[:3, 3] = [at[0], at[1] - c * distance, s * distance + 0.05]
    return T


def picture(
    *things: Cylinder,
    T: np.ndarray | None = None,
    noise: float = 1.0,
    label: bool = True,
    camera: Camera = CAMERA,
    table_radius: float = TABLE_RADIUS,
) -> Frame:
    """A frame whose label map numbers the cylinders from 1; `noise` times (1 mm + 2 mm z^2), and 1% without depth."""
    T = looking_down() if T is None else T
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    o, d = T[:3, 3], rays @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        table = -o[2] / d[:, 2]
        off = np.linalg.norm((o + table[:, None] * d)[:, :2], axis=1) > table_radius
        table[(table < 0) | off] = np.inf
        floor = (FLOOR - o[2]) / d[:, 2]
        wall = (WALL - o[1]) / d[:, 1]
        best = np.minimum(table, np.minimum(np.where(floor > 0, floor, np.inf), np.where(wall > 0, wall, np.inf)))
        ids = np.zeros(len(d), np.int32)
        for i, thing in enumerate(things, start=1):
            p = o - [thing.x, thing.y, thing.base]
            a, b = (d[:, :2] ** 2).sum(1), (d[:, :2] * p[:2]).sum(1)
            side = (-b - np.sqrt(b * b - a * ((p[:2] ** 2).sum() - thing.radius**2))) / a
            z = p[2] + side * d[:, 2]
            side[~((side > 0) & (z >= 0) & (z <= thing.height))] = np.inf
            hollow = thing.radius - WALL_THICKNESS if thing.is_open else 0.0

            def level(z: float, least: float, most: float, p: np.ndarray = p) -> np.ndarray:
                t = (z - p[2]) / d[:, 2]
                radius = np.linalg.norm((p + t[:, None] * d)[:, :2], axis=1)
                return np.where((t > 0) & (radius >= least) & (radius <= most), t, np.inf)

            hit = np.minimum(side, level(thing.height, hollow, thing.radius))
            if thing.is_open:
                inner = (-b + np.sqrt(b * b - a * ((p[:2] ** 2).sum() - hollow**2))) / a
                z = p[2] + inner * d[:, 2]
                inner[~((inner > 0) & (z >= WALL_THICKNESS) & (z <= thing.height))] = np.inf
                hit = np.minimum(hit, np.minimum(inner, level(WALL_THICKNESS, 0.0, hollow)))
            ids[hit < best] = i
            best = np.minimum(best, hit)
    depth = best * rays[:, 2]
    rng = np.random.default_rng(0)
    depth = depth + noise * (1e-3 + 2e-3 * depth**2) * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.01 * (noise > 0)] = np.nan
    colours = np.array(
        [[200, 190, 170], [220, 40, 30], [30, 60, 220], [40, 180, 60], [250, 240, 60], [90, 30, 120]], np.uint8
    )
    shape = (camera.height, camera.width)
    return Frame(
        colours[ids].reshape(*shape, 3),
        depth.reshape(shape).astype(np.float32),
        camera,
        label=ids.reshape(shape) if label else None,
    )


def to_world(points_camera: np.ndarray, T: np.ndarray) -> np.ndarray:
    return points_camera @ T[:3, :3].T + T[:3, 3]


def to_camera(points_world: np.ndarray, T: np.ndarray) -> np.ndarray:
    return (points_world - T[:3, 3]) @ T[:3, :3]
