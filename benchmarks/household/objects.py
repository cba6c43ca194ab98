"""Objects and pictures that the shipped prior and its network learn from, in small jobs for many processes.

A job's work depends on its numbers alone. Four families: tabletop objects, the household generator's things, the
variants of a folder's meshes, and those of a folder of Infinigen's objects (`probnerf.training.infinigen`).
"""

import pickle
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

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
        return f"{self.family}-{self.first:06d}"


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
    part = made.things.with_suffix(".part")
    part.write_bytes(pickle.dumps(things))
    part.replace(made.things)
    return replace(made, count=len(shapes))


def draw_scenes(number: int, sources: list[Path], views: int, out: Path) -> Path | str:
    """Pictures of scenes as perception sees them, so many of each object of the sources; or why there are none."""
    path = out / f"scenes-{number:06d}.npz"
    if path.exists():
        return path
    things = [thing for source in sources for thing in pickle.loads(source.read_bytes())]
    try:
        draw_views(np.random.default_rng([number, 71]), things, views, SIZE, looks=LOOKS)[0].save(path)
    except Exception as error:  # costs these pictures alone
        return f"scenes {number}: {error!r}"
    return path


def _meshes(job: Job) -> tuple[ShapeSet, list[LearntObject]]:
    sets, things = [], []
    for index in range(job.first, job.first + job.count):
        try:
            mesh = _household(index) if job.folder is None else _of_folder(job.folder, index)
        except ValueError:  # a stretched or fallen variant may be no object
            continue
        thing, seed = placed(mesh[0], np.random.default_rng([mesh[1], 43])), mesh[1]
        shapes, paint = sample_mesh(thing, seed), index % PAINTS
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
