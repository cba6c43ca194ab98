"""Procedural paint for triangle meshes: plain, banded along an axis, or printed in blobs, lit by one lamp."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from probnerf.objects.tabletop_sampler import random_colour, random_light

PLAIN, BANDED, PRINTED = range(3)
_SHARES = (0.45, 0.3, 0.25)


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours and their pattern, as functions of the place in the cube."""

    texture: int
    colours: Float[np.ndarray, "3 3"]  # in [0, 1]; the first is the ground
    axis: Float[np.ndarray, "3"]  # unit vector across the bands
    bands: Float[np.ndarray, "3"]  # bands per cube unit, phase in turns, threshold of the sine
    waves: Float[np.ndarray, "2 3 4"]  # two prints: sums of three sinusoids (wave vector, phase)
    level: Float[np.ndarray, "2"]
    light: Float[np.ndarray, "3"]  # unit vector towards the lamp
    ambient: Float[np.ndarray, "3"]
    lamp: Float[np.ndarray, "3"]

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours in [0, 1] of surface points (cube units) with unit normals: Lambert plus ambient."""
        paint = np.broadcast_to(self.colours[0], points.shape).copy()
        if self.texture == BANDED:
            turns = self.bands[0] * (points @ self.axis) + self.bands[1]
            paint[np.sin(2.0 * np.pi * turns) > self.bands[2]] = self.colours[1]
        elif self.texture == PRINTED:
            for k in (1, 0):
                wave = self.waves[k]
                print_ = np.sin(points @ wave[:, :3].T + wave[:, 3]).sum(axis=1) > self.level[k]
                paint[print_] = self.colours[k + 1]
        facing = np.maximum(normals @ self.light, 0.0)[:, None]
        return np.clip(paint * (self.ambient + self.lamp * facing), 0.0, 1.0)

    @property
    def description(self) -> Float[np.ndarray, "p"]:
        """The parameters as numbers of order 1, angles as cosine and sine; zeros for a pattern that is not used."""
        banded, printed = self.texture == BANDED, self.texture == PRINTED
        phase = 2.0 * np.pi * self.bands[1]
        parts = [
            2.0 * self.colours - 1.0,
            banded * np.array([*self.axis, self.bands[0], np.cos(phase), np.sin(phase), self.bands[2]]),
            printed * 0.1 * self.waves[..., :3],
            printed * np.cos(self.waves[..., 3]),
            printed * np.sin(self.waves[..., 3]),
            printed * self.level,
            self.light,
            self.ambient,
            self.lamp,
            2.0 * np.eye(3)[self.texture],
        ]
        return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)


def draw_paint(rng: np.random.Generator) -> Paint:
    """A random paint. Most bands lie across the vertical or across the object's longest axis, as on real things."""
    waves = rng.normal(size=(2, 3, 4))
    waves[..., :3] *= (rng.uniform(4.0, 11.0) / np.linalg.norm(waves[..., :3], axis=-1))[..., None]
    waves[..., 3] = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    free = rng.normal(size=3)
    way = rng.random()
    axis = np.eye(3)[2] if way < 0.5 else np.eye(3)[0] if way < 0.8 else free / np.linalg.norm(free)
    light, ambient, lamp = random_light(rng)
    return Paint(
        texture=int(rng.choice(3, p=_SHARES)),
        colours=np.stack([random_colour(rng) for _ in range(3)]),
        axis=axis,
        bands=np.array([rng.uniform(0.3, 2.5), rng.random(), rng.uniform(-0.6, 0.6)]),
        waves=waves,
        level=rng.uniform(-0.2, 0.9, 2),
        light=light,
        ambient=ambient,
        lamp=lamp,
    )
