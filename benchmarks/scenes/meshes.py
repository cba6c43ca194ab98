"""Meshes of other sources on the simulated table, seen by the family's camera, with their true solid.

A mesh is sampled as a dense cloud of surface points and need not be closed. A picture shows the nearest point in each
cell of a fine pixel grid. The solid is every voxel that holds a point, and every voxel that these enclose.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy import ndimage

from benchmarks.scenes.vessels import FINE, GRID, VesselView, ViewConfig, in_table, simulated_camera, stand
from calibration.camera import Camera
from perception.observation.object_frame import object_frame
from perception.observation.segmentation import segment
from perception.observation.settings import ObserveConfig
from perception.observation.visibility import seen_voxels
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import FaultlessImage, TableScene, render
from perception.sources.frame import Frame
from probnerf.rendering.occupancy import coarsen

_SUB = 3  # fine pixels a side of each pixel; odd, so that one is in the middle
_DENSITY = 8.0  # points a fine pixel of surface: one in 3000 is left open
LONGEST = (0.10, 0.20)  # m; the largest side of a mesh is drawn from


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points on a surface and their normals, world frame, metres."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]


def read_mesh(path: Path, rng: np.random.Generator) -> trimesh.Trimesh:
    """A mesh file as an object on the table: its own up, lowest point at z = 0, turned and placed at random, metres.

    Raises ValueError where the file holds no surface.
    """
    mesh = trimesh.load_mesh(path)
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not float(mesh.extents.max()) > 0:
        raise ValueError(f"{path} holds no triangles")
    mesh.apply_scale(rng.uniform(*LONGEST) / float(mesh.extents.max()))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(-np.pi, np.pi), [0, 0, 1]))
    low, high = mesh.bounds
    at = rng.uniform(-0.05, 0.05, 2)
    mesh.apply_translation([at[0] - 0.5 * (low[0] + high[0]), at[1] - 0.5 * (low[1] + high[1]), -low[2]])
    return mesh


def mesh_view(path: Path, seed: int, config: ViewConfig | None = None) -> VesselView:
    """One view of a mesh through the faulty sensor, as perception takes it, and what is there.

    Raises ValueError where perception refuses.
    """
    config = config or ViewConfig()
    rng = np.random.default_rng([seed, 53])
    mesh = read_mesh(path, rng)
    middle, camera = mesh.bounds.mean(axis=0), simulated_camera(config)
    T = stand(middle, 0.5 * float(mesh.extents.max()), rng, config)
    fine_px = float(np.linalg.norm(T[:3, 3] - middle)) / (config.focal * _SUB)  # m
    count = int(_DENSITY * mesh.area / fine_px**2)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(1 << 31)))
    cloud = Cloud(np.asarray(points), np.asarray(mesh.face_normals)[faces])
    picture = picture_of(cloud, camera, T, rng.uniform(0.2, 0.9, 3))
    frame = sense(picture, camera, T, seed)
    found = segment(frame, 1)[0]
    cube = object_frame(frame, found, ObserveConfig())
    faultless = Frame(frame.rgb, picture.depth.astype(np.float32), camera, frame_id=frame.frame_id)
    inverse = np.linalg.inv(T)
    in_cube = cube.to_cube(cloud.points @ inverse[:3, :3].T + inverse[:3, 3])
    return VesselView(
        seed=seed,
        frame=frame,
        segment=found,
        cube=cube,
        shape=None,
        T_canonical_view=np.eye(4),
        solid=(there := coarsen(enclosed(in_cube, FINE), GRID)),
        body=there,
        seen=seen_voxels(faultless, found, cube, GRID) | in_table(GRID),
        near_handle=np.zeros((GRID,) * 3, bool),
    )


def enclosed(points: Float[np.ndarray, "n 3"], grid: int) -> np.ndarray:
    """Voxels of [-1, 1]^3 that hold a point, and those that they enclose."""
    at = np.floor((points + 1.0) * 0.5 * grid).astype(int)
    at = at[np.all((at >= 0) & (at < grid), axis=1)]
    shell = np.zeros((grid,) * 3, bool)
    shell[tuple(at.T)] = True
    return ndimage.binary_fill_holes(shell)


def picture_of(
    cloud: Cloud, camera: Camera, T_world_camera: Float[np.ndarray, "4 4"], colour: Float[np.ndarray, "3"]
) -> FaultlessImage:
    """What a faultless camera sees of one object on the table, lit from above the camera; its label is 1."""
    room = render(TableScene(()), camera, T_world_camera)
    inverse = np.linalg.inv(T_world_camera)
    seen = cloud.points @ inverse[:3, :3].T + inverse[:3, 3]
    fine = np.floor((camera.project(seen) + 0.5) * _SUB).astype(int)
    height, width = camera.height * _SUB, camera.width * _SUB
    inside = np.all((fine >= 0) & (fine < [width, height]), axis=1) & (seen[:, 2] > 0)
    order = np.flatnonzero(inside)[np.argsort(-seen[inside, 2])]  # the nearest is written last
    u, v = fine[order].T
    towards = T_world_camera[:3, 3] + [0.0, 0.0, 0.5] - cloud.points[order]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    light = 0.35 + 0.65 * np.abs(np.einsum("ni,ni->n", cloud.normals[order], towards))
    depth = np.full((height, width), np.inf)
    shade = np.zeros((height, width))
    depth[v, u], shade[v, u] = seen[order, 2], light

    def blocks(a: np.ndarray) -> np.ndarray:
        return a.reshape(camera.height, _SUB, camera.width, _SUB).swapaxes(1, 2).reshape(*room.depth.shape, -1)

    depth, shade = blocks(depth), blocks(shade)
    hit = depth < room.depth[..., None]
    middle = _SUB * _SUB // 2
    own = shade[..., None] * colour
    depths = np.where(hit, depth, room.depth[..., None])
    return FaultlessImage(
        rgb=np.where(hit[..., None], own, room.rgb[:, :, None, :]).mean(axis=2),
        depth=depths[..., middle],
        nearest=np.where(hit.any(axis=-1), depths.min(axis=-1), room.nearest),
        farthest=np.where(hit.all(axis=-1), depths.max(axis=-1), np.maximum(depths.max(axis=-1), room.farthest)),
        label=hit[..., middle].astype(np.int32),
    )
