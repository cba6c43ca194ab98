"""The household family: closed meshes of things that stand and lie on real tables, drawn from a seed.

It is the tabletop family grown: vessels of every sort, boxes, fruit, tools and toys at true size. Proportions are drawn
from what such things usually are; none was measured on a scanned data set. Seeds are split as in `tabletop`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from probnerf.objects import household_boxes as boxes
from probnerf.objects import household_kitchenware as kitchenware
from probnerf.objects import household_tools as tools
from probnerf.objects import household_toys as toys
from probnerf.objects import household_vessels as vessels
from probnerf.objects.household_parts import Solid
from probnerf.objects.tabletop import TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS

__all__ = ["FAMILIES", "TEST_SEEDS", "TRAIN_SEEDS", "VALIDATION_SEEDS", "HouseholdObject", "draw_mesh"]

TAG = 0x48534C44  # with the seed, makes the generator: other families of the same seed are independent
SMALLEST_M, LARGEST_M = 0.03, 0.35  # the longest side of the bounding box
MAX_FACES = 20_000
TOLERANCE_M = 2e-5  # surfaces move by less than this where faces are saved


@dataclass(frozen=True)
class Family:
    """A kind of household thing and how it is drawn."""

    name: str
    kind: str  # "vessel", "box" or "other"
    weight: float  # its share of all objects is weight / sum of weights
    draw: Callable[[np.random.Generator], Solid]
    any_pose: bool = True


@dataclass(frozen=True)
class HouseholdObject:
    """One object. mesh: watertight, metres, z up, in its natural pose with its lowest point at z = 0.

    A vessel's axis is z, with a handle at +x and a spout at -x. Any other bounding box is centred on x = y = 0.
    """

    mesh: trimesh.Trimesh
    kind: str  # "vessel" (hollow or for filling, open or closed), "box" or "other"
    name: str  # the family's
    any_pose: bool  # whether it is also found in other stable poses than its natural one


FAMILIES = (
    Family("can", "vessel", 4.5, vessels.can),
    Family("bottle", "vessel", 6.0, vessels.bottle),
    Family("jar", "vessel", 3.5, vessels.jar),
    Family("mug", "vessel", 6.0, vessels.mug),
    Family("bowl", "vessel", 3.0, vessels.bowl, any_pose=False),
    Family("plate", "vessel", 1.5, vessels.dish, any_pose=False),
    Family("free lathe vase", "vessel", 4.0, vessels.vase),
    Family("pan", "vessel", 2.0, kitchenware.pan, any_pose=False),
    Family("pot", "vessel", 2.0, kitchenware.pot, any_pose=False),
    Family("teapot", "vessel", 2.5, kitchenware.teapot, any_pose=False),
    Family("pitcher", "vessel", 1.5, kitchenware.pitcher),
    Family("stemware", "vessel", 1.5, kitchenware.stemware),
    Family("bucket", "vessel", 1.0, kitchenware.bucket),
    Family("flask", "vessel", 1.0, kitchenware.flask),
    Family("chamfered box", "box", 4.0, boxes.chamfered_box),
    Family("smooth box", "box", 3.0, boxes.smooth_box),
    Family("tapered box", "box", 2.0, boxes.tapered_box),
    Family("tray", "box", 2.0, boxes.tray),
    Family("lidded box", "box", 2.0, boxes.lidded_box),
    Family("book", "box", 1.5, boxes.book),
    Family("gable carton", "box", 1.5, boxes.gable_carton),
    Family("brick", "box", 1.0, boxes.brick),
    Family("tin", "box", 1.5, boxes.tin),
    Family("tissue box", "box", 0.7, boxes.tissue_box),
    Family("multipack", "box", 0.8, boxes.multipack),
    Family("hammer", "other", 1.2, tools.hammer),
    Family("screwdriver", "other", 1.2, tools.screwdriver),
    Family("wrench", "other", 1.0, tools.wrench),
    Family("pliers", "other", 1.2, tools.pliers),
    Family("scissors", "other", 1.0, tools.scissors),
    Family("brush", "other", 1.2, tools.brush),
    Family("torch", "other", 1.2, tools.torch),
    Family("cutlery", "other", 2.0, tools.cutlery),
    Family("dumbbell", "other", 0.8, tools.dumbbell),
    Family("ring", "other", 1.2, tools.ring),
    Family("hook", "other", 1.2, tools.hook),
    Family("handheld", "other", 1.8, tools.handheld),
    Family("spectacles", "other", 0.6, tools.spectacles),
    Family("round fruit", "other", 2.5, toys.round_fruit),
    Family("long fruit", "other", 1.8, toys.long_fruit),
    Family("ball", "other", 1.4, toys.ball),
    Family("animal", "other", 3.5, toys.animal),
    Family("figure", "other", 2.0, toys.figure),
    Family("vehicle", "other", 2.0, toys.vehicle),
    Family("blocks", "other", 1.6, toys.blocks),
    Family("toy of superquadrics", "other", 2.4, toys.superquadric_toy),
    Family("controller", "other", 1.0, toys.controller),
    Family("shoe", "other", 2.0, toys.shoe),
    Family("turned stand", "other", 2.6, toys.turned_stand),
    Family("lid", "other", 1.4, kitchenware.lid, any_pose=False),
    Family("pouch", "other", 1.2, toys.pouch),
    Family("arch", "other", 0.6, toys.arch),
)


def draw_mesh(seed: int) -> HouseholdObject:
    """The object of a seed: the family by weight, then its shape and size. The same seed gives the same mesh."""
    rng = np.random.default_rng([seed, TAG])
    weights = np.asarray([family.weight for family in FAMILIES])
    family = FAMILIES[rng.choice(len(FAMILIES), p=weights / weights.sum())]
    mesh = mesh_of(family.draw(rng), centred=family.kind != "vessel")
    return HouseholdObject(mesh, family.kind, family.name, family.any_pose)


def mesh_of(solid: Solid, centred: bool) -> trimesh.Trimesh:
    """The solid as a mesh on the plane z = 0, its size and number of faces within the limits.

    centred: whether its bounding box is centred on the z axis. If not, z stays its axis.
    """
    solid = max(solid.decompose(), key=lambda body: body.volume())  # a cavity may cut crumbs off a handle
    tolerance = TOLERANCE_M
    solid = solid.simplify(tolerance)
    while solid.num_tri() > MAX_FACES:
        tolerance *= 2.0
        solid = solid.simplify(tolerance)
    arrays = solid.to_mesh64()
    vertices = arrays.vert_properties[:, :3]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    base = [*(0.5 * (low + high)[:2] if centred else (0.0, 0.0)), low[2]]
    longest = (high - low).max()
    vertices = (vertices - base) * (np.clip(longest, SMALLEST_M, LARGEST_M) / longest)
    return trimesh.Trimesh(vertices, arrays.tri_verts.astype(np.int64), process=False)
