"""Pictures to train the posterior network on: random objects on simulated tables, as perception sees them.

They are drawn in parts, each a file that depends on its number alone, so that drawing can stop and go on. They do not
depend on the prior: a part holds each object's description, from which the prior's recognition tells its latents.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from foundation.whole_file import whole_file
from foundation.worker_pool import worker_pool
from perception.simulation.examples import Example, ExampleDraws, draw_example
from perception.simulation.mesh_scene import MeshShape
from perception.simulation.plain_pictures import PlainDraws, TrainingPicture, draw_plain
from perception.simulation.view_draws import ViewDraws
from probnerf.prior.networks import Recognition
from probnerf.training.learnt_objects import Families, LearntObject, draw_objects
from probnerf.training.picture_set import PictureSet, recognised

OBJECTS, VIEWS = 64, 2  # of a part; many views of few objects teach a network those objects, not how to tell shapes
PLAIN_OBJECTS, PLAIN_VIEWS = 256, 6  # of a part of plain pictures
PLAIN = PLAIN_OBJECTS * PLAIN_VIEWS
LOOKS = ViewDraws(focal=(180.0, 420.0))  # pictures are shrunk anyway; coarser ones are drawn faster


@dataclass(frozen=True, eq=False)
class PicturePart:
    """N pictures of M objects; as `PictureSet`, with descriptions in the place of latents."""

    rgb: np.ndarray  # u8 [N, S, S, 3]
    distance: np.ndarray  # f16 [N, S, S]
    unknown: np.ndarray  # u8 [N, S, S]
    T_view_camera: np.ndarray  # f32 [N, 4, 4]
    tan_half_fov: np.ndarray  # f32 [N]
    pose_sigma: np.ndarray  # f32 [N, 5]
    yaw: np.ndarray  # f32 [N]
    pose: np.ndarray  # f32 [N, 4]
    row: np.ndarray  # i32 [N], of the object
    description: np.ndarray  # f16 [M, d]
    kind: np.ndarray  # u8 [M]
    family: np.ndarray  # u8 [M]
    seed: np.ndarray  # i64 [M]

    def save(self, path: Path) -> None:
        """Write atomically."""
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "PicturePart":
        with np.load(path, allow_pickle=False) as file:
            return cls(**{f.name: file[f.name] for f in fields(cls)})


def draw_part(
    number: int,
    families: Families,
    objects: int,
    views: int,
    size: int,
    draws: ExampleDraws | None = None,
    looks: ViewDraws | None = None,
) -> tuple[PicturePart, Counter[str]]:
    """One part: so many views of each of its objects, less those that perception refuses, and its reasons."""
    rng = np.random.default_rng([number, 71])
    return draw_views(rng, draw_objects(rng, objects, families), views, size, draws, looks)


def draw_views(
    rng: np.random.Generator,
    things: Sequence[LearntObject],
    views: int,
    size: int,
    draws: ExampleDraws | None = None,
    looks: ViewDraws | None = None,
) -> tuple[PicturePart, Counter[str]]:
    """So many views of each of these objects among others of them, less those that perception refuses."""
    shapes = [MeshShape(t.vertices, t.faces, t.half_extent, t.colours, lit=True) for t in things]
    pictures, rows, reasons = [], [], Counter[str]()
    for row, shape in enumerate(shapes):
        for _ in range(views):
            found = draw_example(rng, shape, shapes, size, draws, looks)
            if isinstance(found, Example):
                pictures.append(_training_picture(found))
                rows.append(row)
            else:
                reasons[found] += 1
    return _part(pictures, np.array(rows, np.int32), things), reasons


def draw_plain_part(
    number: int, families: Families, objects: int, views: int, size: int, draws: PlainDraws | None = None
) -> PicturePart:
    """One part of plain pictures (`plain_pictures`)."""
    rng = np.random.default_rng([number, 73])
    return draw_plain_views(rng, draw_objects(rng, objects, families), views, size, draws)


def draw_plain_views(
    rng: np.random.Generator, things: Sequence[LearntObject], views: int, size: int, draws: PlainDraws | None = None
) -> PicturePart:
    """So many plain pictures of each of these objects."""
    pictures, rows = [], []
    for row, thing in enumerate(things):
        drawn = draw_plain(rng, thing, views, size, draws)
        pictures += drawn
        rows += [row] * len(drawn)
    return _part(pictures, np.array(rows, np.int32), things)


def draw_parts(
    folder: Path,
    numbers: range,
    families: Families,
    size: int,
    processes: int,
    *,
    plain: bool = False,
    objects: int | None = None,
    views: int | None = None,
) -> Iterator[Path]:
    """The files of these parts, in any order: those that are there already, and the others when they are drawn."""
    objects = objects or (PLAIN_OBJECTS if plain else OBJECTS)
    views = views or (PLAIN_VIEWS if plain else VIEWS)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {number: folder / f"{'plain' if plain else 'part'}_{number:05d}.npz" for number in numbers}
    missing = [number for number, path in paths.items() if not path.exists()]
    yield from (path for number, path in paths.items() if number not in missing)
    if not missing:
        return
    with worker_pool(processes) as pool:
        jobs = {pool.submit(_draw_kept, paths[n], n, families, objects, views, size, plain): n for n in missing}
        for job in as_completed(jobs):
            job.result()
            yield paths[jobs[job]]


def picture_set(parts: Sequence[PicturePart], recognition: Recognition | None) -> PictureSet:
    """The parts' pictures with their objects' latents, as recognition tells them (without one: none, K = 0)."""
    described = [part.description for part in parts]
    nothing = ((np.zeros((len(each), 0), np.float32),) * 2 for each in described)
    latents = list(nothing) if recognition is None else recognised(recognition, described)
    kept = {f.name for f in fields(PictureSet)} & {f.name for f in fields(PicturePart)} - {"kind"}
    owner = [(part.family.astype(np.int64) << 40) + part.seed for part in parts]
    return PictureSet(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in kept},
        mean=np.concatenate([mean[part.row] for (mean, _), part in zip(latents, parts, strict=True)]),
        sd=np.concatenate([sd[part.row] for (_, sd), part in zip(latents, parts, strict=True)]),
        object_id=np.concatenate([each[part.row] for each, part in zip(owner, parts, strict=True)]),
        kind=np.concatenate([part.kind[part.row] for part in parts]),
    )


def _draw_kept(path: Path, number: int, families: Families, objects: int, views: int, size: int, plain: bool) -> None:
    if plain:
        draw_plain_part(number, families, objects, views, size).save(path)
    else:
        draw_part(number, families, objects, views, size, looks=LOOKS)[0].save(path)


def _training_picture(example: Example) -> TrainingPicture:
    seen, pose = example.picture, example.pose
    return TrainingPicture(
        rgb=np.asarray(seen.rgb),
        distance=np.asarray(seen.distance),
        unknown=np.asarray(seen.unknown),
        T_view_camera=np.asarray(seen.T_view_camera),
        tan_half_fov=float(seen.tan_half_fov),
        pose_sigma=example.pose_sigma,
        yaw=float(np.arctan2(pose[1], pose[0])),
        pose=pose[[2, 3, 4, 6]],
    )


def _part(pictures: list[TrainingPicture], rows: np.ndarray, things: Sequence[LearntObject]) -> PicturePart:
    def stacked(name: str, kind: type) -> np.ndarray:
        return np.stack([np.asarray(getattr(picture, name)) for picture in pictures]).astype(kind)

    return PicturePart(
        rgb=np.round(255.0 * stacked("rgb", np.float32)).astype(np.uint8),
        distance=stacked("distance", np.float16),
        unknown=stacked("unknown", np.uint8),
        T_view_camera=stacked("T_view_camera", np.float32),
        tan_half_fov=stacked("tan_half_fov", np.float32),
        pose_sigma=stacked("pose_sigma", np.float32),
        yaw=stacked("yaw", np.float32),
        pose=stacked("pose", np.float32),
        row=rows,
        description=np.stack([t.description for t in things]).astype(np.float16),
        kind=np.array([t.kind for t in things], np.uint8),
        family=np.array([t.family for t in things], np.uint8),
        seed=np.array([t.seed for t in things], np.int64),
    )
