"""Training views: pictures of procedural objects from random cameras, drawn once and kept in memory.

Each camera looks approximately at the cube's centre, as does the crop that `perception` makes of a real frame.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from probnerf.geometry import look_at, pinhole_rays
from probnerf.objects.ray_tracer import trace_batch
from probnerf.objects.tabletop import sample_objects
from probnerf.prior.encoder_input import ENCODER_RADIUS


@dataclass(frozen=True)
class ViewSet:
    """Pictures of N objects, V views each, S x S pixels. Range: 0 for a miss, below 0 if unknown."""

    seeds: np.ndarray  # [N]
    rgb: np.ndarray  # u8 [N, V, S, S, 3]
    range: np.ndarray  # f32 [N, V, S, S], distance along the ray in cube units
    T_object_camera: np.ndarray  # f32 [N, V, 4, 4]
    tan_half_fov: np.ndarray  # f32 [N, V]

    @property
    def size(self) -> int:
        """Pixels per side."""
        return self.rgb.shape[2]


def joined_views(sets: Sequence[ViewSet]) -> ViewSet:
    """One set of the objects of several with equally many and equally large pictures."""
    return ViewSet(**{f.name: np.concatenate([getattr(s, f.name) for s in sets]) for f in fields(ViewSet)})


def random_camera(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """T_object_camera and the tangent of the half field of view. Elevation 5 to 75 degrees, distance 3 to 10 units."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(5, 75))
    distance = rng.uniform(3.0, 10.0)
    position = distance * np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    target = rng.normal(0.0, 0.08, 3)
    tan_half = ENCODER_RADIUS / distance * np.exp(rng.normal(0.0, 0.1))
    return look_at(position, target), float(tan_half)


def draw_views(
    seeds: np.ndarray, views: int, size: int, slack: float = 1.0, progress: Callable[[int, int], None] | None = None
) -> ViewSet:
    """Render `views` random pictures of each object. The cameras depend only on the object's seed."""
    rgb = np.zeros((len(seeds), views, size, size, 3), np.uint8)
    ranges = np.zeros((len(seeds), views, size, size), np.float32)
    transforms = np.zeros((len(seeds), views, 4, 4), np.float32)
    tangents = np.zeros((len(seeds), views), np.float32)
    block = 64
    for start in range(0, len(seeds), block):
        chosen = seeds[start : start + block]
        padded = np.resize(chosen, block)  # one compiled size
        objects = sample_objects([int(s) for s in padded], slack)
        generators = [np.random.default_rng([int(s), 11]) for s in padded]
        for v in range(views):
            cameras = [random_camera(g) for g in generators]
            rays = [pinhole_rays(T, 0.5 * size / tangent, size) for T, tangent in cameras]
            _, distance, colour = trace_batch(objects, np.stack([o for o, _ in rays]), np.stack([d for _, d in rays]))
            rows = slice(start, start + len(chosen))
            picture = np.asarray(colour)[: len(chosen)].reshape(-1, size, size, 3)
            rgb[rows, v] = np.round(255.0 * picture).astype(np.uint8)
            distance = np.asarray(distance)[: len(chosen)].reshape(-1, size, size)
            ranges[rows, v] = np.where(np.isfinite(distance), distance, 0.0)
            transforms[rows, v] = np.stack([T for T, _ in cameras[: len(chosen)]])
            tangents[rows, v] = [f for _, f in cameras[: len(chosen)]]
        if progress is not None:
            progress(min(start + block, len(seeds)), len(seeds))
    return ViewSet(seeds=np.asarray(seeds), rgb=rgb, range=ranges, T_object_camera=transforms, tan_half_fov=tangents)
