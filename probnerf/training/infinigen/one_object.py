"""One object by one of Infinigen's generators, as a file: the part of `make_objects.py` that needs Blender.

Blender (`bpy`) and Infinigen are imported where they are used: only child processes load them.
Infinigen: Raistrick et al., "Infinigen Indoors", CVPR 2024 (BSD 3-clause).
"""

import importlib
import random
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

Kind = Literal["vessel", "box", "other"]
MAX_FACES = 20_000
FRUIT_FACES = 1_500  # of one fruit in a bowl
MERGE_DISTANCE = 1e-6  # metres: vertices closer than this are one
LABEL_DISTANCE = 3e-3  # metres that a label may stand off
SOURCE = "infinigen.assets.objects"


class Factory(NamedTuple):
    """One of Infinigen's generators: its module below `infinigen.assets.objects`, its class, its things' kind."""

    module: str
    name: str
    kind: Kind


FACTORIES: dict[str, Factory] = {
    "Cup": Factory("tableware", "CupFactory", "vessel"),
    "Bottle": Factory("tableware", "BottleFactory", "vessel"),
    "Bowl": Factory("tableware", "BowlFactory", "vessel"),
    "Can": Factory("tableware", "CanFactory", "vessel"),
    "Jar": Factory("tableware", "JarFactory", "vessel"),
    "Pot": Factory("tableware", "PotFactory", "vessel"),
    "Pan": Factory("tableware", "PanFactory", "vessel"),
    "Plate": Factory("tableware", "PlateFactory", "other"),
    "Wineglass": Factory("tableware", "WineglassFactory", "vessel"),
    "FoodBox": Factory("tableware", "FoodBoxFactory", "box"),
    "FoodBag": Factory("tableware", "FoodBagFactory", "other"),
    "Lid": Factory("tableware", "LidFactory", "other"),
    "Knife": Factory("tableware", "KnifeFactory", "other"),
    "Spoon": Factory("tableware", "SpoonFactory", "other"),
    "Fork": Factory("tableware", "ForkFactory", "other"),
    "FruitContainer": Factory("tableware", "FruitContainerFactory", "vessel"),
    "Vase": Factory("table_decorations", "VaseFactory", "vessel"),
    "Book": Factory("table_decorations", "BookFactory", "box"),
    "Basket": Factory("organizer", "BasketBaseFactory", "vessel"),
    "DeskLamp": Factory("lamp", "DeskLampFactory", "other"),
    "Apple": Factory("fruits", "FruitFactoryApple", "other"),
    "NatureShelfTrinkets": Factory("elements.nature_shelf_trinkets.generate", "NatureShelfTrinketsFactory", "other"),
}


@dataclass(frozen=True)
class Made:
    """An object in the index.

    `watertight`: each edge is passed as often one way as the other, so that winding numbers are whole; parts may touch
    and overlap. `extents_m`: the sides of its box along x, y, z."""

    file: str
    factory: str
    seed: int
    faces: int
    watertight: bool
    extents_m: tuple[float, float, float]
    kind: Kind
    seconds: float


class Task(NamedTuple):
    """An object to make."""

    factory: str
    seed: int

    @property
    def file(self) -> str:
        return f"{self.factory}_{self.seed}.ply"


def make(task: Task, folder: Path) -> Made:
    """Generate one object in an empty scene and write its file.

    Raises whatever Infinigen or Blender raises, and ValueError for an empty mesh."""
    import bpy
    import trimesh

    start = time.monotonic()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    random.seed(task.seed)
    np.random.seed(task.seed)  # noqa: NPY002 (Infinigen draws from the global generator)
    vertices, faces = merged(*triangles(spawn(task)))
    vertices, faces = merged(*decimated(vertices, without_labels(vertices, faces)))
    if task.factory == "Apple":  # comes 2 m wide
        width = np.random.default_rng(task.seed).uniform(0.06, 0.10)
        vertices *= width / np.ptp(vertices[:, :2], axis=0).max()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise ValueError("the mesh is empty or not finite")
    closed = balanced(mesh.faces)
    if closed and mesh.volume < 0:
        mesh.invert()
    part = folder / (task.file + ".part")
    part.write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=False))
    part.replace(folder / task.file)
    x, y, z = (round(float(side), 4) for side in mesh.extents)
    kind = FACTORIES[task.factory].kind
    seconds = round(time.monotonic() - start, 2)
    return Made(task.file, *task, len(mesh.faces), closed, (x, y, z), kind, seconds)


def spawn(task: Task) -> list[Any]:
    """Blender's objects that make up one object. Without `finalize_assets`, which only paints, but for fruit."""
    module, name, _ = FACTORIES[task.factory]
    generator = getattr(importlib.import_module(f"{SOURCE}.{module}"), name)
    if task.factory == "FruitContainer":
        factory = generator(task.seed + 1_000_000)  # with the same seed, its bowl would be that of Bowl or Pot
        bowl = factory.spawn_asset(task.seed)
        fill_with_fruit(bowl, task.seed)
        return [bowl, *bowl.children_recursive]
    if task.factory == "Basket":  # holes and round edges: minutes, and Blender's booleans tear them
        return [generator(task.seed, params={"has_holes": False, "frame_sub_level": 0}).spawn_asset(task.seed)]
    factory = generator(task.seed)
    if task.factory == "NatureShelfTrinkets":  # sized by its placeholder, 10 to 15 cm
        placeholder = factory.spawn_placeholder(task.seed, (0, 0, 0), (0, 0, 0))
        thing = factory.spawn_asset(task.seed, placeholder=placeholder)
    else:
        thing = factory.spawn_asset(task.seed)
    return [thing, *thing.children_recursive]


def fill_with_fruit(bowl: Any, seed: int) -> None:
    """Scatter apples in a bowl, as Infinigen's `FruitCover` does. Its own fruit is of any sort, drawn from a set, whose
    order changes from run to run; most sorts have thousands of parts and fall to pieces when decimated."""
    from infinigen.assets.objects.fruits.apple import FruitFactoryApple
    from infinigen.assets.objects.tableware.fruit_container import FruitCover
    from infinigen.assets.utils.misc import make_normalized_factory
    from infinigen.core.placement.factory import make_asset_collection
    from infinigen.core.util import blender
    from infinigen.core.util.math import FixedSeed

    with FixedSeed(seed):
        fruit = make_normalized_factory(FruitFactoryApple)(int(np.random.randint(100_000)))  # noqa: NPY002
        cover = FruitCover.__new__(FruitCover)
        things = make_asset_collection(fruit, n=3, verbose=False, as_list=True)
        for thing in things:
            blender.modify_mesh(thing, "DECIMATE", ratio=min(1.0, FRUIT_FACES / (2 * len(thing.data.polygons))))
        cover.col = blender.group_in_collection(things, name="fruit", reuse=False)
        cover.col.hide_viewport = True  # the fruit itself lies at the origin
        cover.dimension = float(np.mean([np.mean(thing.dimensions) for thing in things]))
        cover.shrink_rate = max(cover.dimension, 2.0)
        cover.apply(bowl, selection="lower_inside")


def triangles(things: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """All meshes joined, with modifiers: vertices (n, 3) in metres in the scene's frame, triangles (m, 3)."""
    import bpy

    scene = bpy.context.evaluated_depsgraph_get()
    vertices, faces, total = [], [], 0
    for thing in (thing for thing in things if thing.type == "MESH"):
        evaluated = thing.evaluated_get(scene)
        mesh = evaluated.to_mesh()
        mesh.transform(thing.matrix_world)
        mesh.calc_loop_triangles()
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners)
        vertices.append(points.reshape(-1, 3).astype(float))
        faces.append(corners.reshape(-1, 3) + total)
        total += len(mesh.vertices)
        evaluated.to_mesh_clear()
    if not total:
        raise ValueError("the factory made no mesh")
    return np.concatenate(vertices), np.concatenate(faces)


def merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with each vertex once. Of faces that lie on each other, opposite ones cancel and equal ones
    become one: parts that touch with their caps become one closed part."""
    import trimesh

    points = trimesh.Trimesh(vertices, faces, process=False).kdtree
    pairs = points.query_pairs(MERGE_DISTANCE, output_type="ndarray")
    group = trimesh.graph.connected_component_labels(pairs, node_count=len(vertices))
    _, first = np.unique(group, return_index=True)
    faces = group[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    ordered = np.sort(faces, axis=1)
    _, one, inverse = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    same_turn = (
        (faces == ordered).all(1) | (np.roll(faces, 1, 1) == ordered).all(1) | (np.roll(faces, 2, 1) == ordered).all(1)
    )
    turns = np.bincount(inverse.ravel(), np.where(same_turn, 1, -1))
    kept = ordered[one][turns != 0]
    kept[turns[turns != 0] < 0] = kept[turns[turns != 0] < 0][:, ::-1]
    return vertices[first], kept


def balanced(faces: np.ndarray) -> bool:
    """Whether each edge is passed as often one way as the other."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return not np.bincount(edge.ravel(), np.sign(edges[:, 1] - edges[:, 0])).any()


def without_labels(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles without open sheets that lie on closed parts (labels of bottles, covers of books): without all open
    parts, if the box around the closed ones is the whole box but for `LABEL_DISTANCE`."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(faces))
    _, edge, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    border = (count[edge.ravel()] == 1).reshape(-1, 3).any(axis=1)
    closed = faces[~np.isin(part, part[border])]
    if not len(closed):
        return faces
    box, whole = ([vertices[f].min((0, 1)), vertices[f].max((0, 1))] for f in (closed, faces))
    return closed if np.abs(np.subtract(box, whole)).max() < LABEL_DISTANCE else faces


def decimated(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with at most `MAX_FACES` triangles (Blender's quadric edge collapse)."""
    import bpy

    data = bpy.data.meshes.new("joined")
    data.from_pydata(vertices.tolist(), [], faces.tolist())
    joined = bpy.data.objects.new("joined", data)
    bpy.context.scene.collection.objects.link(joined)
    modifier = joined.modifiers.new("fewer", "DECIMATE")
    for _ in range(4):  # the modifier may stop a little above its ratio
        if len(faces) <= MAX_FACES:
            return vertices, faces
        modifier.ratio *= 0.99 * MAX_FACES / len(faces)
        bpy.context.view_layer.update()
        vertices, faces = triangles([joined])
    raise ValueError(f"{len(faces)} faces remain after decimation")
