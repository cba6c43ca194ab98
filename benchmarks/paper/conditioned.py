"""One picture of an object of known pose as a question, and what is truly there: the paper's single-view inference.

An object's pose is known and there is no range. 256 rays of a 64 x 64 picture are compared, most of them on the object
or near its outline. Each stands for four pixels (`power` 4), where the paper compares all 128 x 128.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from benchmarks.measures.refitted import walls
from benchmarks.paper.families import TAN_HALF_FOV, Family, Seen, Subject, render
from probnerf.geometry import pinhole_rays
from probnerf.pixel_status import FREE, OBJECT
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.rendering import foam
from probnerf.rendering.occupancy import coarsen, voxel_centres
from probnerf.types import Observation, Rays, on_device

SIZE = 64  # px a side of a picture
OBJECT_RAYS, FREE_RAYS = 160, 96
NEAR_PX = 4  # half of the free rays pass within so many pixels of the object
GRID = 32  # voxels an axis of hidden space
HELD_OUT = ((35.0, 20.0), (125.0, 20.0), (-145.0, 20.0), (-55.0, 20.0))  # azimuth, elevation, degrees


@dataclass(frozen=True)
class Place:
    """From where an object is seen, and how much of the picture is given."""

    name: str
    azimuth: float  # degrees, 0 is ahead of the object
    elevation: float
    left_half: bool = False  # only the picture's left half is given


PLACES = {
    "cars": (Place("back", 180.0, 15.0), Place("three-quarter view", 40.0, 20.0)),
    "bodies": (Place("left half of a front view", 0.0, 0.0, left_half=True), Place("front", 0.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Conditioned:
    """An object seen from one place."""

    family: Family
    seed: int
    place: Place
    preset_size: int = SIZE  # px a side of the encoder's picture

    @cached_property
    def subject(self) -> Subject:
        """What is there."""
        return self.family.draw(self.seed)

    @cached_property
    def T_object_camera(self) -> Float[np.ndarray, "1 4 4"]:
        """The given camera."""
        return self.family.camera(self.place.azimuth, self.place.elevation)[None]

    @cached_property
    def given(self) -> Seen:
        """The picture, whole."""
        return render(self.subject, self.T_object_camera, SIZE)

    @cached_property
    def known(self) -> Bool[np.ndarray, "s s"]:
        """Pixels that are given."""
        known = np.ones((SIZE, SIZE), bool)
        if self.place.left_half:
            known[:, SIZE // 2 :] = False
        return known

    @cached_property
    def held_out(self) -> Seen:
        """Pictures from four other places, on the family's own band of elevations."""
        low, high = self.family.elevation
        cameras = [self.family.camera(a, float(np.clip(e, low, high))) for a, e in HELD_OUT]
        return render(self.subject, np.stack(cameras), SIZE)

    def observation(self, seed: int) -> Observation:
        """Rays of the given pixels, evenly among object, outline and the rest."""
        rng = np.random.default_rng([seed, self.seed, 71])
        mask = self.given.mask[0]
        near = ndimage.binary_dilation(mask, iterations=NEAR_PX) & ~mask

        def drawn(where: Bool[np.ndarray, "s s"], count: int) -> np.ndarray:
            (at,) = np.nonzero((where & self.known).ravel())
            return rng.choice(at, count, replace=len(at) < count)

        free = (drawn(near, FREE_RAYS // 2), drawn(~mask & ~near, FREE_RAYS // 2))
        pixels = np.concatenate([drawn(mask, OBJECT_RAYS), *free])
        origins, directions = rays_of(self.T_object_camera[0])
        count = len(pixels)
        return Observation(
            rays=Rays(on_device(origins[pixels]), on_device(directions[pixels])),
            status=on_device(np.where(np.arange(count) < OBJECT_RAYS, OBJECT, FREE), np.int32),
            rgb=on_device(self.given.rgb[0].reshape(-1, 3)[pixels] / 255.0),
            rgb_valid=on_device(np.ones(count), bool),
            range=on_device(np.zeros(count)),
            range_sigma=on_device(np.ones(count)),
            range_valid=on_device(np.zeros(count), bool),
            limit=on_device(np.full(count, 0.5 * foam.FAR)),
            pose_sigma=on_device(np.zeros(5)),
            colour_count=OBJECT_RAYS,
        )

    @property
    def picture(self) -> EncoderPicture:
        """What the encoder sees."""
        size = self.preset_size
        seen = self.given if size == SIZE else render(self.subject, self.T_object_camera, size)
        unknown = np.zeros((size, size))
        if self.place.left_half:
            unknown[:, size // 2 :] = 1.0
        return EncoderPicture(
            rgb=on_device(seen.rgb[0] / 255.0),
            distance=on_device(np.where(seen.mask[0], -1.0, 0.0)),
            unknown=on_device(unknown),
            T_view_camera=on_device(self.T_object_camera[0]),
            tan_half_fov=on_device(TAN_HALF_FOV),
        )

    @cached_property
    def solid(self) -> Bool[np.ndarray, "g g g"]:
        """Voxels of which a corner (of 64^3) is in the solid, [i_x, i_y, i_z]."""
        return coarsen(walls(self.subject.mesh), GRID)

    @cached_property
    def hidden(self) -> Bool[np.ndarray, "g g g"]:
        """Voxels whose centre the given pixels did not see to be free: behind the surface, or not in the picture."""
        centres = voxel_centres(GRID).reshape(-1, 3)
        T = self.T_object_camera[0]
        points = (centres - T[:3, 3]) @ T[:3, :3]
        u, v = (np.floor((points[:, i] / points[:, 2] / TAN_HALF_FOV + 1.0) * 0.5 * SIZE).astype(int) for i in (0, 1))
        inside = (u >= 0) & (u < SIZE) & (v >= 0) & (v < SIZE) & (points[:, 2] > 0)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        end = np.where(self.given.mask[0], self.given.range[0], np.inf)[v, u]
        seen = inside & self.known[v, u] & (np.linalg.norm(points, axis=1) < end)
        return ~seen.reshape(GRID, GRID, GRID)


def rays_of(T_object_camera: Float[np.ndarray, "4 4"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and unit directions of a picture's pixels, row by row, cube units."""
    origins, directions = pinhole_rays(T_object_camera, 0.5 * SIZE / TAN_HALF_FOV, SIZE)
    return np.asarray(origins), np.asarray(directions)


@cache
def base_rate(family: Family, seeds: range) -> Float[np.ndarray, "g g g"]:
    """Share of these objects that occupy each voxel."""
    return np.mean([coarsen(walls(family.draw(seed).mesh), GRID) for seed in seeds], axis=0)
