"""Objects to take training pictures of: a mesh with its colours, and what recognition reads of the same object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int
from skimage.measure import marching_cubes

from probnerf.objects.household import draw_mesh
from probnerf.objects.mesh import MeshObject, read_folder
from probnerf.objects.shape_kinds import kind_of_name
from probnerf.objects.tabletop import TabletopObject, colour, sample_object, signed_distance
from probnerf.training.mesh_shapes import NATURAL, PAINTS, held_out, paint_of, placed, sample_mesh, variant
from probnerf.training.shape_set import ShapeSet, batch_of
from probnerf.training.tabletop_shapes import tabletop_shapes
from probnerf.types import BASE_Z, KINDS

Colours = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
TABLETOP, HOUSEHOLD, FOLDER = range(3)  # families
_CELLS = 72  # of the tabletop family's meshes, along each side of the bounding box
_CHUNK = 1 << 14  # points coloured at a time: one compiled size


@dataclass(frozen=True, eq=False)
class LearntObject:
    """One object in one paint."""

    vertices: Float[np.ndarray, "v 3"]  # canonical, cube units
    faces: Int[np.ndarray, "f 3"]
    half_extent: float  # m per cube unit
    colours: Colours  # lit, of points (cube units) with unit normals
    description: Float[np.ndarray, "d"]  # what `Recognition` reads
    kind: int  # index into KINDS
    family: int
    seed: int


@dataclass(frozen=True)
class Families:
    """What objects are drawn from, as `farside train` does."""

    tabletop: range
    tabletop_share: float
    household: range
    household_variants: int
    folders: tuple[Path, ...] = ()
    folder_variants: int = 8


def draw_objects(rng: np.random.Generator, count: int, families: Families) -> list[LearntObject]:
    """Random objects. Beside the tabletop family's share, every variant of every mesh is as likely."""
    meshes = [mesh for folder in families.folders for mesh in _meshes(folder)]
    household = len(families.household) * families.household_variants
    others = household + len(meshes) * families.folder_variants
    tabletop = int(rng.binomial(count, families.tabletop_share if others else 1.0))
    start, stop = families.tabletop.start, families.tabletop.stop
    drawn = tabletop_objects(rng.integers(start, stop, tabletop)) if tabletop else []
    for _ in range(count - tabletop):
        pick = int(rng.integers(others))
        if pick < household:
            seed, index = divmod(pick, families.household_variants)
            drawn.append(household_object(families.household[seed], index, int(rng.integers(PAINTS))))
        else:
            which, index = divmod(pick - household, families.folder_variants)
            name, mesh = meshes[which]
            thing, seed = variant(mesh, name, kind_of_name(name), index)
            drawn.append(learnt(thing, seed, int(rng.integers(PAINTS)), FOLDER))
    return drawn


def household_object(seed: int, index: int, paint: int) -> LearntObject:
    """A variant of the household generator's object."""
    made = draw_mesh(seed)
    thing, own = variant(made.mesh, f"{made.name}_{seed}", made.kind, index, NATURAL if made.any_pose else 1.0, 0.0)
    return learnt(thing, own, paint, HOUSEHOLD)


def learnt(thing: MeshObject, seed: int, paint: int, family: int) -> LearntObject:
    """An object in its canonical frame, as perception may misplace it, in one of its paints."""
    thing = placed(thing, np.random.default_rng([seed, 43]))
    description = _description(sample_mesh(thing, seed), 0, paint)
    colours = paint_of(seed, paint).rgb
    kind = KINDS.index(thing.kind)
    return LearntObject(thing.vertices, thing.faces, thing.half_extent, colours, description, kind, family, seed)


def _description(shapes: ShapeSet, row: int, paint: int) -> Float[np.ndarray, "d"]:
    batch = batch_of(shapes, np.random.default_rng(0), np.array([row]), 4, 1, np.array([paint]))
    return np.asarray(batch.description[0])


@cache
def _meshes(folder: Path) -> Sequence[tuple[str, trimesh.Trimesh]]:
    return [(name, mesh) for name, mesh in read_folder(folder) if not isinstance(mesh, str) and not held_out(name)]


def tabletop_objects(seeds: np.ndarray) -> list[LearntObject]:
    """The tabletop family's objects of these seeds, as meshes with their own colours."""
    shapes, made = tabletop_shapes(seeds), []
    for row, seed in enumerate(seeds):
        obj = sample_object(int(seed))
        vertices, faces = tabletop_mesh(obj)
        made.append(
            LearntObject(
                vertices=vertices,
                faces=faces,
                half_extent=float(obj.half_extent_m / obj.scale),
                colours=Coloured(obj),
                description=_description(shapes, row, 0),
                kind=int(shapes.kind[row]),
                family=TABLETOP,
                seed=int(seed),
            )
        )
    return made


def tabletop_mesh(obj: TabletopObject) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The tabletop object's surface (cube units) as triangles, by marching cubes on its exact distances."""
    distance, low, cell = (np.array(a) for a in _grid(obj))  # copies: marching cubes wants to own them
    vertices, faces, _, _ = marching_cubes(distance, 0.0)
    return vertices * cell + low, faces[:, ::-1].astype(np.int64)


@jax.jit
def _grid(obj: TabletopObject) -> tuple[Array, Array, Array]:
    """Distances at the corners of cells about the object, the first corner, and the cells' sides."""
    base = jnp.array([0.0, 0.0, BASE_Z])
    shift = base + jnp.append(obj.shift, 0.0)
    low, high = ((corner - base) * obj.scale + shift for corner in (obj.lower - 0.03, obj.upper + 0.03))
    at = jnp.linspace(0.0, 1.0, _CELLS + 1)
    corners = low + jnp.stack(jnp.meshgrid(at, at, at, indexing="ij"), axis=-1) * (high - low)
    return signed_distance(obj, corners), low, (high - low) / _CELLS


_colour = jax.jit(colour)


@dataclass(frozen=True, eq=False)
class Coloured:
    """A tabletop object's own colours."""

    obj: TabletopObject

    def __call__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        parts = []
        for start in range(0, len(points), _CHUNK):
            rows = np.resize(np.arange(start, min(start + _CHUNK, len(points))), _CHUNK)
            parts.append(
                np.asarray(_colour(self.obj, points[rows].astype(np.float32), normals[rows].astype(np.float32)))
            )
        return np.concatenate(parts)[: len(points)] if parts else np.zeros((0, 3))
