"""Objects and pictures that a household prior and its network learn from, in small jobs for many processes.

A job's work depends on its numbers alone. Four families: tabletop objects, the household generator's things, the
variants of a folder's meshes, and those of a folder of Infinigen's objects (`probnerf.training.infinigen`).
"""

import zlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from foundation.whole_file import whole_file
from perception.simulation.training_pictures import LOOKS, draw_plain_views, draw_views
from probnerf.objects.household import draw_mesh
from probnerf.objects.mesh import MeshObject, mesh_files, read_mesh
from probnerf.objects.shape_kinds import kind_of_name
from probnerf.objects.tabletop import TRAIN_SEEDS, sample_object
from probnerf.training.learnt_objects import FOLDER, HOUSEHOLD, TABLETOP, Coloured, LearntObject, tabletop_mesh
from probnerf.training.mesh_shapes import NATURAL, PAINTS, held_out, paint_of, placed, sample_mesh, variant
from probnerf.training.shape_set import ShapeSet, batch_of, joined, load_shapes
from probnerf.training.tabletop_shapes import tabletop_shapes
from probnerf.types import KINDS

EACH = 32  # objects of a job
BLOCK = 256  # tabletop objects of a job, one compiled size
VIEWS = 6  # plain pictures of each object
SIZE = 32  # px a side


@dataclass(frozen=True)
class Job:
    """The objects first to first + count of a family."""

    family: str  # "tabletop", "household" or the name of a folder
    folder: Path | None  # of meshes
    first: int
    count: int

    @property
    def name(self) -> str:
        """Of its files."""
        where = "" if self.folder is None else f"-{zlib.crc32(str(self.folder.resolve()).encode()):08x}"
        return f"{self.family}{where}-{self.first:06d}"


@dataclass(frozen=True)
class Made:
    """What a job left."""

    family: str
    shapes: Path
    plain: Path
    things: Path
    count: int  # of shapes


@cache
def files(folder: Path) -> list[Path]:
    """The folder's mesh files to learn from, in an order that mixes their classes."""
    found = [file for file in mesh_files(folder) if not held_out(file.stem)]
    return [found[i] for i in np.random.default_rng(0).permutation(len(found))]


def make(job: Job, out: Path) -> Made | str:
    """The job's shapes, plain pictures and objects as files in `out`; or why nothing came of it."""
    kept = {end: out / f"{job.name}.{end}" for end in ("shapes", "plain", "things")}
    made = Made(job.family, **kept, count=0)
    if made.things.exists():
        return replace(made, count=len(load_shapes(made.shapes)))
    try:
        shapes, things = _tabletop(job) if job.family == "tabletop" else _meshes(job)
        plain = draw_plain_views(np.random.default_rng([job.first, len(job.family), 73]), things, VIEWS, SIZE)
    except Exception as error:  # costs these objects alone
        return f"{job.name}: {error!r}"
    shapes.save(made.shapes)
    plain.save(made.plain)
    save_things(made.things, things)
    return replace(made, count=len(shapes))


def draw_scenes(number: int, sources: list[Path], views: int, out: Path) -> Path | str:
    """Pictures of scenes as perception sees them, so many of each object of the sources; or why there are none."""
    path = out / f"scenes-{number:06d}.npz"
    if path.exists():
        return path
    try:
        things = [thing for source in sources for thing in load_things(source)]
        draw_views(np.random.default_rng([number, 71]), things, views, SIZE, looks=LOOKS)[0].save(path)
    except Exception as error:  # costs these pictures alone
        return f"scenes {number}: {error!r}"
    return path


def save_things(path: Path, things: list[LearntObject]) -> None:
    """Write objects atomically. Their colours follow from their seeds (`load_things`)."""
    ends = np.cumsum([(len(t.vertices), len(t.faces)) for t in things], axis=0)
    arrays: dict[str, Any] = {
        name: np.array([getattr(t, name) for t in things]) for name in ("half_extent", "kind", "family", "seed")
    }
    arrays |= {
        "vertices": np.concatenate([t.vertices for t in things]).astype(np.float32),
        "faces": np.concatenate([t.faces for t in things]).astype(np.int32),
        "description": np.stack([t.description for t in things]).astype(np.float16),
        "ends": ends,
    }
    with whole_file(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)


def load_things(path: Path) -> list[LearntObject]:
    """The objects of a file."""
    with np.load(path, allow_pickle=False) as file:
        told = {name: file[name] for name in file.files}
    vertices, faces = (np.split(told[name], told["ends"][:-1, k]) for k, name in enumerate(("vertices", "faces")))
    things = []
    for row, (family, seed) in enumerate(zip(told["family"].tolist(), told["seed"].tolist(), strict=True)):
        things.append(
            LearntObject(
                vertices=vertices[row],
                faces=faces[row],
                half_extent=float(told["half_extent"][row]),
                colours=Coloured(sample_object(seed)) if family == TABLETOP else paint_of(seed, seed % PAINTS).rgb,
                description=told["description"][row],
                kind=int(told["kind"][row]),
                family=family,
                seed=seed,
            )
        )
    return things


def _meshes(job: Job) -> tuple[ShapeSet, list[LearntObject]]:
    sets, things = [], []
    for index in range(job.first, job.first + job.count):
        try:
            mesh = _household(index) if job.folder is None else _of_folder(job.folder, index)
        except ValueError:  # a stretched or fallen variant may be no object
            continue
        thing, seed = placed(mesh[0], np.random.default_rng([mesh[1], 43])), mesh[1]
        shapes, paint = sample_mesh(thing, seed), seed % PAINTS
        sets.append(shapes)
        things.append(
            LearntObject(
                vertices=thing.vertices,
                faces=thing.faces,
                half_extent=thing.half_extent,
                colours=paint_of(seed, paint).rgb,
                description=_description(shapes, 0, paint),
                kind=KINDS.index(thing.kind),
                family=HOUSEHOLD if job.folder is None else FOLDER,
                seed=seed,
            )
        )
    if not sets:
        raise ValueError("none of its meshes can be learnt from")
    return joined(sets), things


def _household(index: int) -> tuple[MeshObject, int]:
    """Every second thing of the generator is stretched, and falls as it may."""
    made = draw_mesh(TRAIN_SEEDS[index])
    natural = NATURAL if made.any_pose else 1.0
    return variant(made.mesh, f"{made.name}_{TRAIN_SEEDS[index]}", made.kind, index % 2, natural, bend=0.0)


def _of_folder(folder: Path, index: int) -> tuple[MeshObject, int]:
    """Once through all meshes as they are, then through variants of them."""
    found = files(folder)
    file = found[index % len(found)]
    mesh = read_mesh(file)
    if isinstance(mesh, str):
        raise ValueError(f"{file}: {mesh}")
    return variant(mesh, file.stem, kind_of_name(file.stem), index // len(found))


def _tabletop(job: Job) -> tuple[ShapeSet, list[LearntObject]]:
    """All shapes; every eighth is also an object to take pictures of, for its mesh costs more than the shape."""
    seeds = np.asarray(TRAIN_SEEDS[job.first : job.first + job.count])
    shapes, things = tabletop_shapes(seeds), []
    for row in range(0, len(seeds), 8):
        obj = sample_object(int(seeds[row]))
        vertices, faces = tabletop_mesh(obj)
        things.append(
            LearntObject(
                vertices=vertices.astype(np.float32),
                faces=faces.astype(np.int32),
                half_extent=float(obj.half_extent_m / obj.scale),
                colours=Coloured(obj),
                description=_description(shapes, row, 0),
                kind=int(shapes.kind[row]),
                family=TABLETOP,
                seed=int(seeds[row]),
            )
        )
    return shapes, things


def _description(shapes: ShapeSet, row: int, paint: int) -> np.ndarray:
    batch = batch_of(shapes, np.random.default_rng(0), np.array([row]), 4, 1, np.array([paint]))
    return np.asarray(batch.description[0])
