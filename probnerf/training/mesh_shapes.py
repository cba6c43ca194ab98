"""Shapes to learn from, made of meshes: a folder of any, or the household generator's."""

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import trimesh
from jaxtyping import Float

from probnerf.objects.free_form import bent
from probnerf.objects.household import draw_mesh
from probnerf.objects.mesh import MeshObject, canonical, read_folder, rests
from probnerf.objects.paint import Paint, draw_paint
from probnerf.objects.shape_kinds import kind_of_name
from probnerf.objects.tabletop_sampler import SLACK_LOG_SCALE, SLACK_SHIFT
from probnerf.training.shape_set import (
    ANYWHERE,
    CLIP,
    GRID,
    NEAR,
    OFFSET,
    PAINT_NUMBERS,
    SURFACE,
    TABLETOP_NUMBERS,
    ShapeSet,
    as_units,
    centres,
    in_cube,
    joined,
    nearest,
)
from probnerf.types import BASE_Z, KINDS

PAINTS = 4  # of each mesh
STRETCH = 0.12  # standard deviation of each axis's log scale, of all variants but the first
NATURAL = 0.4  # share of the variants that stand as their mesh does; the others as they fall
BEND = 0.2  # of the box's sides: how far the control points of a bent mesh move
BENT = 0.5  # share of the variants of a folder's mesh that are bent; the generator draws its own
Progress = Callable[[int, int], None]


def held_out(name: str, share: int = 10) -> bool:
    """Whether a mesh's class (its name without a number at the end) is kept for validation: one class in `share`."""
    return zlib.crc32(name.rstrip("_0123456789").encode()) % share == 0


def variant(
    mesh: trimesh.Trimesh, name: str, kind: str, index: int, natural: float = NATURAL, bend: float = BENT
) -> tuple[MeshObject, int]:
    """A variant of a mesh in its canonical frame, and its seed, which name and index fix. The first is the mesh.

    Others are stretched and stand or fall; a share of `bend` is bent before, and half of these mirrored.
    """
    seed = zlib.crc32(f"{name}/{index}".encode())
    if index:
        rng = np.random.default_rng([seed, 59])
        if rng.random() < bend:
            mesh = bent(mesh, rng, BEND)
            mesh.apply_transform(np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0, 1.0]))
        mesh = rests(mesh, np.random.default_rng([seed, 47]), natural, STRETCH)
    return canonical(mesh.vertices, mesh.faces, kind, name), seed


def folder_shapes(
    folder: Path, variants: int, validation: bool = False, progress: Progress | None = None
) -> tuple[ShapeSet, list[str]]:
    """The folder's meshes, so many variants of each, and what was left out and why.

    Held-out classes are taken with `validation` alone. Raises ValueError where nothing is left.
    """
    files = list(read_folder(folder))
    made, left_out = [], [f"{name}: {mesh}" for name, mesh in files if isinstance(mesh, str)]
    for done, (name, mesh) in enumerate(files, start=1):
        if isinstance(mesh, str) or held_out(name) != validation:
            continue
        made += [_sample(*variant(mesh, name, kind_of_name(name), v)) for v in range(variants)]
        if progress is not None:
            progress(done, len(files))
    if not made:
        raise ValueError(f"{folder}: none of its {len(files)} meshes can be learnt from; the first: {left_out[:1]}")
    return joined(made), left_out


def household_shapes(seeds: range, variants: int, progress: Progress | None = None) -> ShapeSet:
    """The household generator's objects of these seeds, so many variants of each."""

    def all_variants() -> Iterator[ShapeSet]:
        for done, seed in enumerate(seeds, start=1):
            thing = draw_mesh(seed)
            natural = NATURAL if thing.any_pose else 1.0
            yield from (
                _sample(*variant(thing.mesh, f"{thing.name}_{seed}", thing.kind, v, natural, bend=0.0))
                for v in range(variants)
            )
            if progress is not None:
                progress(done, len(seeds))

    return joined(list(all_variants()))


def _sample(thing: MeshObject, seed: int) -> ShapeSet:
    return sample_mesh(placed(thing, np.random.default_rng([seed, 43])), seed)


def placed(thing: MeshObject, rng: np.random.Generator) -> MeshObject:
    """The object where perception may think it: the cube guessed a little too large or small, and beside it."""
    scale = float(np.exp(SLACK_LOG_SCALE * rng.standard_normal()))
    base = np.array([0.0, 0.0, BASE_Z])
    shift = np.append(SLACK_SHIFT * rng.standard_normal(2), 0.0)
    vertices = (thing.vertices - base) * scale + base + shift
    return replace(thing, vertices=vertices, half_extent=thing.half_extent / scale)


def paint_of(seed: int, index: int) -> Paint:
    """One of the paints in which an object of this seed is learnt."""
    return draw_paint(np.random.default_rng([seed, 53, index]))


class Painted(Protocol):
    """How an object is painted, and what recognition reads of it."""

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours in [0, 1] of surface points (cube units) with unit normals."""
        ...

    @property
    def description(self) -> Float[np.ndarray, "p"]:
        """At most PAINT_NUMBERS + TABLETOP_NUMBERS numbers of order 1."""
        ...


def sample_mesh(thing: MeshObject, seed: int, paints: Sequence[Painted] | int = PAINTS) -> ShapeSet:
    """A set of one object (placed already) with these paints, or with so many that are drawn from the seed."""
    rng = np.random.default_rng([seed, 41])
    surface, normal = thing.surface(rng, SURFACE + NEAR)
    width = np.exp(rng.uniform(np.log(OFFSET[0]), np.log(OFFSET[1]), (NEAR, 1)))
    near = surface[SURFACE:] + width * rng.standard_normal((NEAR, 3))
    surface, normal = surface[:SURFACE], normal[:SURFACE]
    points = as_units(np.concatenate([near, rng.uniform(-1.0, 1.0, (ANYWHERE, 3))]))
    grid = centres(GRID)
    distance = thing.signed_distance(np.concatenate([grid, in_cube(points)]))
    drawn = [paint_of(seed, i) for i in range(paints)] if isinstance(paints, int) else paints
    rgb = np.stack([paint.rgb(surface, normal) for paint in drawn])
    return ShapeSet(
        distance=np.clip(distance[: len(grid)], -CLIP, CLIP).astype(np.float16)[None],
        points=points[None],
        inside=(distance[len(grid) :] <= 0.0)[None],
        surface=as_units(surface)[None],
        normal=np.round(127.0 * normal).astype(np.int8)[None],
        valid=np.ones((1, SURFACE), bool),
        anchor=nearest(surface)[None],
        rgb=np.round(255.0 * rgb).astype(np.uint8)[None],
        appearance=np.stack([_appearance(paint) for paint in drawn])[None],
        kind=np.array([KINDS.index(thing.kind)], np.uint8),
    )


def _appearance(paint: Painted) -> np.ndarray:
    numbers = np.zeros(PAINT_NUMBERS + TABLETOP_NUMBERS, np.float16)
    numbers[: len(paint.description)] = paint.description
    return numbers
