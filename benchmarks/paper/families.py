"""The families of the ProbNeRF paper's experiments, in pictures and as shapes to learn from.

Pictures are those of SRN Cars but for their contents: a known canonical pose, a camera at a fixed distance that looks
at the middle, white where nothing is. 50 of each object by default. `python -m benchmarks.paper.families` writes them
in SRN's layout, for `farside train --data`; it goes on where it ended.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from benchmarks.harness.command import command
from benchmarks.harness.progress import say
from benchmarks.paper.bodies import draw_person
from benchmarks.paper.cars import draw_car
from perception.simulation.ray_caster import RayCaster
from probnerf.geometry import look_at, pinhole_rays
from probnerf.objects.mesh import MeshObject
from probnerf.training.mesh_shapes import sample_mesh
from probnerf.training.pictures import ViewSet
from probnerf.training.shape_set import ShapeSet, joined
from probnerf.training.srn_dataset import Instance, write_instance
from probnerf.types import BASE_Z

SPLITS = {"train": range(0, 1_000_000), "val": range(1_000_000, 2_000_000), "test": range(2_000_000, 3_000_000)}
TAN_HALF_FOV = 64.0 / 131.25  # SRN's cameras
VIEWS = 50


def seeds_of(split: str, count: int) -> range:
    """The first seeds of a split. Raises ValueError for one that is not known, or where none are asked for."""
    if split not in SPLITS:
        raise ValueError(f"no split '{split}'; there are: {', '.join(SPLITS)}")
    if count < 1:
        raise ValueError(f"{count} objects were asked for; give 1 or more")
    return SPLITS[split][:count]


class Subject(Protocol):
    """One object of a family: geometry and paint in the canonical cube."""

    @property
    def mesh(self) -> MeshObject:
        """Its surface."""
        ...

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours of surface points (cube units) with unit normals."""
        ...

    @property
    def description(self) -> Float[np.ndarray, "p"]:
        """Its appearance as numbers of order 1."""
        ...


@dataclass(frozen=True)
class Family:
    """What is drawn, and from where it is seen."""

    name: str
    draw: Callable[[int], Subject]
    distance: float  # of the camera from `middle`, cube units
    middle: tuple[float, float, float]  # what cameras look at, cube units
    elevation: tuple[float, float]  # degrees; cameras are uniform on this band of the sphere

    def camera(self, azimuth: float, elevation: float) -> Float[np.ndarray, "4 4"]:
        """T_object_camera of a camera in this direction from the middle, degrees; azimuth 0 is ahead (+x)."""
        a, e = np.radians([azimuth, elevation])
        direction = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        return look_at(np.asarray(self.middle) + self.distance * direction, np.asarray(self.middle))

    def cameras(self, seed: int, count: int = VIEWS) -> Float[np.ndarray, "v 4 4"]:
        """T_object_camera of random views of the object of this seed."""
        rng = np.random.default_rng([seed, 67])
        low, high = np.sin(np.radians(self.elevation))
        azimuths = rng.uniform(-180.0, 180.0, count)
        elevations = np.degrees(np.arcsin(rng.uniform(low, high, count)))
        return np.stack([self.camera(a, e) for a, e in zip(azimuths, elevations, strict=True)])


CARS = Family("cars", draw_car, distance=1.7, middle=(0.0, 0.0, BASE_Z + 0.25), elevation=(-5.0, 85.0))
BODIES = Family("bodies", draw_person, distance=2.0, middle=(0.0, 0.0, BASE_Z + 0.7), elevation=(0.0, 0.0))
FAMILIES = {family.name: family for family in (CARS, BODIES)}


@dataclass(frozen=True, eq=False)
class Seen:
    """One object's pictures."""

    rgb: UInt8[np.ndarray, "v s s 3"]  # white outside the object
    range: Float[np.ndarray, "v s s"]  # distance along the ray, cube units; 0: a miss
    T_object_camera: Float[np.ndarray, "v 4 4"]

    @property
    def mask(self) -> Bool[np.ndarray, "v s s"]:
        """Object pixels."""
        return self.range > 0


def render(subject: Subject, T_object_camera: Float[np.ndarray, "v 4 4"], size: int) -> Seen:
    """Square pictures of one object, a ray for each pixel's centre."""
    caster = RayCaster([(subject.mesh.vertices, subject.mesh.faces)])
    rgb = np.full((len(T_object_camera), size * size, 3), 255, np.uint8)
    distance = np.zeros((len(T_object_camera), size * size), np.float32)
    for v, T in enumerate(T_object_camera):
        origins, directions = (np.asarray(a, np.float64) for a in pinhole_rays(T, 0.5 * size / TAN_HALF_FOV, size))
        hits = caster.cast(origins, directions)
        hit = hits.mesh >= 0
        points = origins[hit] + hits.distance[hit][:, None] * directions[hit]
        rgb[v, hit] = np.round(255.0 * subject.rgb(points, hits.normal[hit]))
        distance[v, hit] = hits.distance[hit]
    shape = (len(T_object_camera), size, size)
    return Seen(rgb.reshape(*shape, 3), distance.reshape(shape), np.asarray(T_object_camera, np.float32))


def view_set(family: Family, seeds: Sequence[int], views: int, size: int) -> ViewSet:
    """Random views of these objects, to train on."""
    seen = [render(family.draw(seed), family.cameras(seed, views), size) for seed in seeds]
    return ViewSet(
        seeds=np.asarray(seeds),
        rgb=np.stack([each.rgb for each in seen]),
        range=np.stack([each.range for each in seen]),
        T_object_camera=np.stack([each.T_object_camera for each in seen]),
        tan_half_fov=np.full((len(seen), views), TAN_HALF_FOV, np.float32),
    )


def shape_set(family: Family, seeds: Sequence[int], progress: Callable[[int, int], None] | None = None) -> ShapeSet:
    """Solids and surfaces of these objects, to train on."""
    made = []
    for seed in seeds:
        subject = family.draw(seed)
        made.append(sample_mesh(subject.mesh, seed, [subject]))
        if progress is not None:
            progress(len(made), len(seeds))
    return joined(made)


def write_srn(family: Family, seed: int, folder: Path, views: int, size: int) -> Path:
    """The object's pictures in the layout of SRN data sets (`probnerf.training.srn_dataset`), as `folder`/SEED.

    As there, the cube is about the middle of what is seen.
    """
    seen = render(family.draw(seed), family.cameras(seed, views), size)
    T_world_camera = seen.T_object_camera.astype(np.float64)
    T_world_camera[:, :3, 3] *= 0.5  # the cube has side 1 there
    instance = Instance(
        name=f"{seed:07d}",
        focal=0.5 * size / TAN_HALF_FOV,
        centre=(0.5 * size, 0.5 * size),
        barycentre=(0.5 * family.middle[0], 0.5 * family.middle[1], 0.5 * family.middle[2]),
        scale=1.0,
        rgb=seen.rgb,
        mask=seen.mask,
        T_world_camera=T_world_camera,
    )
    return write_instance(folder, instance)


@dataclass(frozen=True)
class Options:
    """Write a family's pictures as an SRN data set."""

    out: Path
    """Folder of the instances."""
    family: Literal["cars", "bodies"] = "cars"
    """What is drawn."""
    split: str = "train"
    """Of which seeds."""
    count: int = 2458
    """Objects, the first seeds."""
    views: int = VIEWS
    """Pictures of each."""
    size: int = 128
    """px a side."""


def main(options: Options) -> None:
    """Write what the folder lacks. An instance is whole if its last pose is there."""
    for done, seed in enumerate(seeds_of(options.split, options.count), start=1):
        if not (options.out / f"{seed:07d}" / "pose" / f"{options.views - 1:06d}.txt").is_file():
            write_srn(FAMILIES[options.family], seed, options.out, options.views, options.size)
        if done % 100 == 0 or done == options.count:
            say(f"{done} of {options.count}")


if __name__ == "__main__":
    command(main, Options)
