"""The family `bodies`: people in clothes and poses, drawn from a seed.

It stands for the paper's renderings of GHUM, whose licence keeps them from here. A CC0 mesh (`body_template`) is posed
by linear blend skinning; each joint turns within its limits. Widths, legs, belly, clothes and light vary.

Cube frame: the person faces +x, hips on x = y = 0, the lowest point on z = BASE_Z; standing height is BODY_EXTENT.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.paper.body_template import load_template
from probnerf.objects.mesh import MeshObject
from probnerf.objects.tabletop_sampler import random_colour, random_light
from probnerf.types import BASE_Z, BODY_EXTENT

TAG = 0x424F4459  # with the seed, makes the generator
SKIN, HAIR, SHIRT, TROUSERS, SHOES = range(5)
SLEEVES = ("none", "short", "long")


@dataclass(frozen=True, eq=False)
class Person:
    """One person in one pose."""

    height: float  # m, standing
    stretch: Float[np.ndarray, "3"]  # of width, depth and leg length
    belly: float  # m to the front
    turns: dict[str, Float[np.ndarray, "3"]]  # rotation vector of each bone that turns, rad, axes of the rest pose
    sleeves: int  # index into SLEEVES
    shorts: bool
    long_hair: bool
    colours: Float[np.ndarray, "5 3"]  # of SKIN to SHOES
    light: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"]
    lamp: Float[np.ndarray, "3"]

    @cached_property
    def posed(self) -> Float[np.ndarray, "v 3"]:
        """Vertices in the cube, by linear blend skinning."""
        rest = load_template()
        transforms: list[np.ndarray] = []
        for name, parent, head in zip(rest.names, rest.parents, self._shaped(rest.heads), strict=True):
            own = np.eye(4)
            if name in self.turns:
                own[:3, :3] = Rotation.from_rotvec(self.turns[name]).as_matrix()
                own[:3, 3] = head - own[:3, :3] @ head
            transforms.append(own if parent < 0 else transforms[parent] @ own)
        points = np.concatenate([self._shaped(rest.vertices), np.ones((len(rest.vertices), 1))], axis=1)
        moved = np.einsum("vb,bij,vj->vi", rest.weights, np.stack(transforms)[:, :3], points)
        unit = BODY_EXTENT / np.ptp(self._shaped(rest.vertices)[:, 2])
        hips = self._shaped(rest.heads)[rest["Hips"]]
        x, y, z = unit * np.array([-moved[:, 1] + hips[1], moved[:, 0] - hips[0], moved[:, 2]])  # faces +x
        return np.stack([x, y, z - z.min() + BASE_Z], axis=1)

    def _shaped(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        rest = load_template()
        hips = rest.heads[rest["Hips"]]
        width, depth, legs = self.stretch
        x, y, z = (points - hips).T
        bulge = self.belly * np.exp(-((z - 0.1) ** 2) / 0.02 - (x / 0.14) ** 2) * (y < 0.0)
        return np.stack([width * x, depth * y - bulge, np.where(z < 0.0, legs * z, z)], axis=1) + hips

    @cached_property
    def mesh(self) -> MeshObject:
        """In its canonical cube."""
        return MeshObject(self.posed, load_template().faces, self.height / BODY_EXTENT, "other", "body")

    @cached_property
    def _worn(self) -> Int[np.ndarray, "v"]:
        """What each vertex shows."""
        rest = load_template()
        bone = np.array(rest.names)[np.argmax(rest.weights, axis=1)]
        _, y, z = rest.vertices.T
        worn = np.full(len(z), SKIN)
        arms = ("Arm", "ForeArm") if self.sleeves == 2 else ("Arm",) if self.sleeves else ()
        shirt = ["LowerBack", "Spine", "Spine1", "Neck", "LeftShoulder", "RightShoulder"]
        shirt += [side + arm for side in ("Left", "Right") for arm in arms]
        worn[np.isin(bone, shirt) & (z < 0.585)] = SHIRT
        legs = ["Hips", "LHipJoint", "RHipJoint", "LeftUpLeg", "RightUpLeg"]
        legs += [] if self.shorts else ["LeftLeg", "RightLeg"]
        worn[np.isin(bone, legs)] = TROUSERS
        worn[np.isin(bone, ["LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"])] = SHOES
        head = np.isin(bone, ["Head", "Neck1", "Neck"]) & (z > 0.55)
        crown = (z > 0.80) | ((y > -0.03) & (z > (0.56 if self.long_hair else 0.69)))
        worn[head & crown] = HAIR
        return worn

    @cached_property
    def _nearest(self) -> cKDTree:
        return cKDTree(self.posed)

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours in [0, 1] of surface points (cube units) with unit normals: Lambert plus ambient."""
        paint = self.colours[self._worn[self._nearest.query(points)[1]]]
        facing = np.maximum(normals @ self.light, 0.0)[:, None]
        return np.clip(paint * (self.ambient + self.lamp * facing), 0.0, 1.0)

    @property
    def description(self) -> Float[np.ndarray, "d"]:
        """The parameters of appearance and pose as numbers of order 1: a coarse grid of distances shows no arm well."""
        flags = [2.0 * self.shorts, 2.0 * self.long_hair, *2.0 * np.eye(3)[self.sleeves]]
        pose = [*self.turns.values(), 5.0 * np.log(self.stretch), [10.0 * self.belly]]
        parts = [2.0 * self.colours - 1.0, self.light, self.ambient, self.lamp, flags, *pose]
        return np.concatenate([np.ravel(np.asarray(part, np.float32)) for part in parts])


def _hinge(bone: str, onto: str, angle: float) -> Float[np.ndarray, "3"]:
    """A turn about the axis in which the rest pose bends already: an elbow's or a knee's."""
    rest = load_template()
    upper, lower = (rest.tails[rest[b]] - rest.heads[rest[b]] for b in (bone, onto))
    axis = np.cross(upper, lower)
    return angle * axis / np.linalg.norm(axis)


def draw_turns(rng: np.random.Generator) -> dict[str, Float[np.ndarray, "3"]]:
    """A pose: each joint's turn within its limits."""

    def between(low: float, high: float) -> float:
        return np.radians(rng.uniform(low, high))

    turns = {}
    for name, spread in (("LowerBack", 6.0), ("Spine", 6.0), ("Spine1", 6.0), ("Neck", 9.0), ("Head", 12.0)):
        turns[name] = np.radians(np.clip(rng.normal(0.0, spread, 3), -2.0 * spread, 2.0 * spread))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        # the rest pose holds an arm 45 degrees from the body; turns about y lift or lower it, about x swing it ahead
        lift = Rotation.from_rotvec([0.0, -sign * between(-38.0, 70.0), 0.0])
        swing = Rotation.from_rotvec([-between(-35.0, 75.0), 0.0, 0.0])
        turns[f"{side}Arm"] = (swing * lift).as_rotvec()
        turns[f"{side}ForeArm"] = _hinge(f"{side}Arm", f"{side}ForeArm", between(-10.0, 95.0))
        hip = between(-20.0, 20.0) if rng.random() < 0.6 else between(20.0, 70.0)
        knee = between(0.0, 20.0) + (max(hip, 0.0) * rng.uniform(0.2, 1.3))
        spread = Rotation.from_rotvec([0.0, -sign * between(-8.0, 12.0), 0.0])
        turns[f"{side}UpLeg"] = (Rotation.from_rotvec([-hip, 0.0, 0.0]) * spread).as_rotvec()
        turns[f"{side}Leg"] = _hinge(f"{side}UpLeg", f"{side}Leg", knee)
    return turns


def draw_person(seed: int) -> Person:
    """The person of a seed."""
    rng = np.random.default_rng([seed, TAG])
    tone = rng.uniform(0.0, 1.0)
    skin = (1.0 - tone) * np.array([0.93, 0.76, 0.65]) + tone * np.array([0.35, 0.22, 0.16])
    hair = np.array([[0.08, 0.06, 0.05], [0.35, 0.2, 0.1], [0.75, 0.58, 0.3], [0.6, 0.6, 0.6]])[rng.integers(4)]
    shoes = rng.uniform(0.05, 0.3, 3) if rng.random() < 0.7 else random_colour(rng)
    light, ambient, lamp = random_light(rng)
    return Person(
        height=rng.uniform(1.5, 1.95),
        stretch=np.exp(rng.normal(0.0, (0.07, 0.08, 0.04))),
        belly=max(0.0, rng.normal(0.0, 0.05)),
        turns=draw_turns(rng),
        sleeves=int(rng.integers(3)),
        shorts=bool(rng.random() < 0.3),
        long_hair=bool(rng.random() < 0.4),
        colours=np.stack([skin, hair, random_colour(rng), random_colour(rng), shoes]),
        light=light,
        ambient=ambient,
        lamp=lamp,
    )
