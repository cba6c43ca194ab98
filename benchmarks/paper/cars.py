"""The family `cars`: procedural road vehicles with exact geometry, drawn from a seed.

It stands for the SRN Cars of the ProbNeRF paper, whose pictures may not be passed on: hatchbacks, saloons, coupes,
estates, off-roaders, vans, minibuses, pickups and ambulances, with windows, lamps, wheels, spoilers and stripes.

Vehicle frame (metres): the front at +x, y to the left, z up, wheels on z = 0, the origin in the middle. Cube frame: as
`probnerf.objects.mesh` has it, the front at +x; lengths divided by `half_extent`, and the wheels on z = BASE_Z.
Proportions are drawn from what road vehicles usually are; none was measured on another data set.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.path import Path as Polygon

from probnerf.objects.household_parts import Section, Solid, disc, log_uniform, plate, rectangle, rounded_box, union
from probnerf.objects.mesh import MeshObject
from probnerf.objects.tabletop_sampler import random_colour, random_light
from probnerf.types import BASE_Z, BODY_EXTENT

TAG = 0x43415253  # with the seed, makes the generator
STYLES = ("hatchback", "saloon", "coupe", "estate", "off-roader", "van", "minibus", "pickup", "ambulance")
SHARES = (0.2, 0.2, 0.12, 0.1, 0.12, 0.1, 0.04, 0.07, 0.05)
GLASS, TYRE, TRIM = (0.12, 0.15, 0.18), (0.07, 0.07, 0.075), (0.16, 0.16, 0.17)
HEADLAMP, TAIL_LAMP, BEACON = (0.95, 0.95, 0.85), (0.75, 0.06, 0.05), (0.15, 0.3, 0.95)
STEP_M = 0.08  # longest edge before the body is bent

# Of each style: length, height (m); then shares of the length, from the front: the bonnet's end, the roof's start and
# end, the rear window's foot, and the tail's height as a share of the belt's (0: the roof goes on to the tail).
_PROPORTIONS = {
    "hatchback": ((3.5, 4.3), (1.40, 1.55), (0.20, 0.28), (0.36, 0.44), (0.80, 0.90), (0.95, 0.99), (0.98, 1.00)),
    "saloon": ((4.2, 5.1), (1.38, 1.50), (0.24, 0.30), (0.38, 0.44), (0.66, 0.74), (0.80, 0.88), (0.95, 1.06)),
    "coupe": ((4.0, 4.7), (1.22, 1.36), (0.30, 0.38), (0.46, 0.52), (0.60, 0.68), (0.88, 0.97), (0.92, 1.04)),
    "estate": ((4.4, 5.0), (1.42, 1.56), (0.24, 0.29), (0.37, 0.42), (0.90, 0.95), (0.97, 0.99), (0.98, 1.00)),
    "off-roader": ((3.9, 4.9), (1.62, 1.90), (0.22, 0.29), (0.31, 0.38), (0.88, 0.95), (0.97, 0.99), (0.98, 1.00)),
    "van": ((4.4, 5.6), (1.85, 2.40), (0.09, 0.17), (0.22, 0.30), (0.97, 0.985), (0.99, 0.995), (0.99, 1.00)),
    "minibus": ((4.8, 6.0), (1.95, 2.60), (0.02, 0.05), (0.09, 0.14), (0.96, 0.985), (0.99, 0.995), (0.99, 1.00)),
    "pickup": ((4.8, 5.6), (1.60, 1.85), (0.22, 0.27), (0.32, 0.37), (0.52, 0.60), (0.56, 0.64), (0.96, 1.02)),
    "ambulance": ((5.2, 6.2), (2.20, 2.70), (0.12, 0.18), (0.24, 0.29), (0.97, 0.985), (0.99, 0.995), (0.99, 1.00)),
}


@dataclass(frozen=True, eq=False)
class Car:
    """One vehicle. Lengths in metres, vehicle frame."""

    style: str
    length: float
    width: float
    height: float
    clearance: float  # of the sill above the road
    belt: float  # height of the windows' lower edge
    bonnet: float  # height of the bonnet's front
    bonnet_end: float  # x of: the windscreen's foot
    roof_start: float
    roof_end: float
    rear_foot: float  # the rear window's foot
    tail: float  # height of the tail
    tumble: float  # how far a side leans in from belt to roof
    nose: float  # share by which the ends are narrower
    wheel: float  # radius
    tyre: float  # width
    axles: tuple[float, float]  # x of the front and rear axle
    pillars: tuple[float, ...]  # x of posts between the side windows
    glazed: float  # x behind which a side has no windows
    spoiler: float  # height above the tail; 0: none
    beacons: bool  # on the roof
    box: float  # an ambulance's box starts at this x; the rear end where there is none
    paint: Float[np.ndarray, "3"]
    second: Float[np.ndarray, "3"]  # of stripe, box and hubs
    stripe: int  # 0: none, 1: along the sides, 2: two along the top, 3: below
    hub: Float[np.ndarray, "3"]
    light: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"]
    lamp: Float[np.ndarray, "3"]

    @property
    def half_extent(self) -> float:
        """Metres per cube unit: the larger of length and height is BODY_EXTENT."""
        return max(self.length, self.height) / BODY_EXTENT

    @cached_property
    def outline(self) -> Float[np.ndarray, "n 2"]:
        """The side view (x, z) without wheels, counter-clockwise."""
        front, rear = 0.5 * self.length, -0.5 * self.length
        c, mid = self.clearance, 0.5 * (self.clearance + self.bonnet)
        flat = self.style in ("van", "minibus", "ambulance", "hatchback", "estate", "off-roader")
        tail = [(self.roof_end, self.height), (self.rear_foot, self.belt if flat else self.tail), (rear, self.tail)]
        if flat:
            tail = [(self.roof_end, self.height), (self.rear_foot, self.belt), (rear, 0.5 * (self.belt + c))]
        points = [
            (rear + 0.06, c),
            (front - 0.12, c),
            (front, mid - 0.05),
            (front - 0.03, self.bonnet),
            (self.bonnet_end, self.belt),
            (self.roof_start, self.height - 0.01),
            *tail,
        ]
        return np.asarray(points)

    @cached_property
    def glass(self) -> Polygon:
        """The side view's windows, posts not taken out."""
        foot, head = self.belt + 0.03, self.height - 0.11
        rise = (foot - self.belt) / (self.height - self.belt), (head - self.belt) / (self.height - self.belt)
        front = [self.bonnet_end + r * (self.roof_start - self.bonnet_end) - 0.07 for r in rise]
        back = [self.rear_foot + r * (self.roof_end - self.rear_foot) + 0.09 for r in rise]
        back = [max(b, self.glazed) for b in back]
        return Polygon([(front[0], foot), (front[1], head), (back[1], head), (back[0], foot), (front[0], foot)])

    @cached_property
    def solid(self) -> Solid:
        """The vehicle in its own frame."""
        section = Section([self.outline]).offset(-0.05).offset(0.05)
        body = plate(section, self.width, upright=True).refine_to_length(STEP_M).warp_batch(self._bent)
        parts, cuts = [], []
        for x in self.axles:
            at = (x, self.wheel)
            cuts.append(plate(disc(1.13 * self.wheel, at), 2.4 * self.tyre, upright=True))
            parts.append(plate(disc(self.wheel, at), self.tyre, upright=True))
        sides = [(0.0, s * (0.5 * self.width - 0.5 * self.tyre - 0.01), 0.0) for s in (-1, 1)]
        arches = [cut.translate((0.0, s * 0.5 * self.width, 0.0)) for cut in cuts for s in (-1, 1)]
        body = body - union(arches)
        if self.style == "pickup":
            floor = max(self.tail - 0.42, 2.3 * self.wheel)
            bed = rectangle((-0.5 * self.length + 0.07, floor), (self.rear_foot - 0.12, self.tail + 1.0))
            body = body - plate(bed, self.width - 0.2, upright=True)
        extras = [wheel.translate(side) for wheel in parts for side in sides]
        axle_rods = [rounded_box((0.12, self.width - 2 * self.tyre, 0.12)).translate((x, 0, self.wheel - 0.06))
                     for x in self.axles]  # fmt: skip
        mirror = rounded_box((0.12, 0.16, 0.13), 0.04)
        extras += [mirror.translate((self._mirrors, s * (0.5 * self.width + 0.02), self.belt - 0.01)) for s in (-1, 1)]
        if self.spoiler:
            extras.append(self._wing())
        if self.beacons:
            bar = rounded_box((0.22, 0.6 * self.width, 0.14), 0.03)
            extras.append(bar.translate((self.roof_start - 0.35, 0.0, self.height - 0.02)))
        if self.box > -0.5 * self.length:
            wide = rounded_box((self.box + 0.5 * self.length, self.width + 0.06, self.height - self.clearance), 0.05)
            extras.append(
                wide.translate((0.5 * (self.box - 0.5 * self.length), 0.0, self.clearance + 0.02)) - union(arches)
            )
        return union([body, *axle_rods, *extras])

    @property
    def _mirrors(self) -> float:  # their x
        return self.bonnet_end + 0.3 * (self.roof_start - self.bonnet_end)

    def _wing(self) -> Solid:
        at, top = -0.5 * self.length + 0.14, max(self.tail, self.belt) + self.spoiler
        if self.style in ("hatchback", "estate", "off-roader"):  # a lip that goes on from the roof
            lip = rounded_box((0.32, 0.8 * self.width, 0.06), 0.02)
            return lip.translate((self.roof_end - 0.1, 0.0, self.height - 0.07))
        wing = rounded_box((0.28, 0.86 * self.width, 0.05), 0.02).translate((at, 0.0, top))
        post = rounded_box((0.14, 0.06, self.spoiler + 0.12)).translate((at, 0.0, top - self.spoiler - 0.1))
        return union([wing, *(post.translate((0.0, s * 0.33 * self.width, 0.0)) for s in (-1, 1))])

    def _bent(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return np.stack([p[:, 0], p[:, 1] * self.half_width(p[:, 0], p[:, 2]) / (0.5 * self.width), p[:, 2]], axis=1)

    def half_width(self, x: Float[np.ndarray, "n"], z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Of the body at these places, m: sides lean in above the belt, ends are narrower."""
        lean = self.tumble * np.clip((z - self.belt) / (self.height - self.belt), 0.0, 1.0)
        end = 1.0 - self.nose * np.abs(2.0 * x / self.length) ** 6
        return (0.5 * self.width - lean) * end

    @cached_property
    def mesh(self) -> MeshObject:
        """In its canonical cube."""
        arrays = self.solid.simplify(1e-3).to_mesh64()
        vertices = arrays.vert_properties[:, :3] / self.half_extent + [0.0, 0.0, BASE_Z]
        return MeshObject(vertices, arrays.tri_verts.astype(np.int64), self.half_extent, "other", self.style)

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours in [0, 1] of surface points (cube units) with unit normals: Lambert plus ambient."""
        paint = self.painted((points - [0.0, 0.0, BASE_Z]) * self.half_extent, normals)
        facing = np.maximum(normals @ self.light, 0.0)[:, None]
        return np.clip(paint * (self.ambient + self.lamp * facing), 0.0, 1.0)

    def painted(self, p: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Colours of surface points (m), unlit."""
        x, y, z = p.T
        side, above = np.abs(normals[:, 1]) > 0.6, normals[:, 2] > 0.4
        ahead, behind = normals[:, 0] > 0.25, normals[:, 0] < -0.25
        front, rear = x > 0.5 * self.length - 0.45, x < -0.5 * self.length + 0.35
        across = np.abs(y) / self.half_width(x, z)
        colour = np.broadcast_to(self.paint, p.shape).copy()

        def put(where: Bool[np.ndarray, "n"], value: tuple[float, ...] | np.ndarray) -> None:
            colour[where] = value

        in_box = x < self.box
        stripe = {
            1: side & (np.abs(z - 0.8 * self.belt) < 0.1),
            2: ~side & (np.abs(np.abs(y) - 0.18) < 0.1),
            3: z < self.clearance + 0.28,
        }.get(self.stripe, np.zeros(len(p), bool))
        put(stripe, self.second)
        put(z < self.clearance + 0.1, TRIM)
        middle = (z > self.belt + 0.06) & (z < self.height - 0.1) & (across < 0.9)
        on_cabin = (x < self.bonnet_end + 0.05) & ~in_box
        put(ahead & middle & on_cabin & (x > self.roof_start - 0.1), GLASS)
        glazed = self.style in ("van", "ambulance") and self.stripe % 2 == 0  # vans without a rear window
        put(behind & middle & (x < self.roof_end + 0.1) & (across < 0.85) & ~np.bool_(glazed), GLASS)
        post = np.zeros(len(p), bool)
        for at in self.pillars:
            post |= np.abs(x - at) < 0.05
        outside = across > 0.9  # a bed's inner walls are no side
        window = side & outside & self.glass.contains_points(np.stack([x, z], axis=1)) & ~post & ~in_box
        put(window, GLASS)
        lamps = np.abs(z - (self.bonnet - 0.12)) < 0.09
        put(front & ahead & lamps & (across > 0.55), HEADLAMP)
        put(front & ahead & (across < 0.5) & (np.abs(z - self.bonnet + 0.2) < 0.1), TRIM)
        put(rear & behind & (across > 0.68) & (np.abs(z - 0.86 * self.belt) < 0.12), TAIL_LAMP)
        put((np.abs(y) > 0.5 * self.width + 0.005) & (np.abs(x - self._mirrors) < 0.2) & (z > self.belt - 0.03), TRIM)
        for axle in self.axles:
            radius = np.hypot(x - axle, z - self.wheel)
            wheel = (radius < 1.03 * self.wheel) & (np.abs(y) > 0.5 * self.width - 1.3 * self.tyre) & (z < self.belt)
            put(wheel, TYRE)
            put(wheel & side & (radius < 0.62 * self.wheel), self.hub)
        if self.box > -0.5 * self.length:
            put(in_box & side & (np.abs(z - self.belt) < 0.16), self.second)
            cross = (np.abs(x - 0.6 * (self.box - 0.5 * self.length)) < 0.3) & (np.abs(z - 1.3 * self.belt - 0.2) < 0.3)
            put(in_box & side & cross, self.second)
        if self.beacons:
            put((z > self.height + 0.02) & ~above | ((z > self.height + 0.05) & above), BEACON)
        return colour

    @property
    def description(self) -> Float[np.ndarray, "d"]:
        """The parameters of appearance as numbers of order 1."""
        numbers = [self.belt, self.bonnet, self.bonnet_end, self.roof_start, self.roof_end, self.rear_foot, self.glazed]
        pillars = [*self.pillars, 0.0, 0.0, 0.0][:3]
        place = np.array([*numbers, *pillars, self.box, *self.axles, self.wheel, self.tyre]) / self.half_extent
        colours = np.concatenate([2.0 * self.paint - 1.0, 2.0 * self.second - 1.0, 2.0 * self.hub - 1.0])
        kinds = 2.0 * np.concatenate([np.eye(4)[self.stripe], np.eye(len(STYLES))[STYLES.index(self.style)]])
        more = [2.0 * self.beacons, 2.0 * (self.spoiler > 0)]
        return np.concatenate([place, colours, self.light, self.ambient, self.lamp, kinds, more]).astype(np.float32)


def draw_car(seed: int) -> Car:
    """The vehicle of a seed."""
    rng = np.random.default_rng([seed, TAG])
    style = str(rng.choice(STYLES, p=SHARES))
    ranges = _PROPORTIONS[style]
    length, height = rng.uniform(*ranges[0]), rng.uniform(*ranges[1])
    bonnet_end, roof_start, roof_end, rear_foot = (length * (0.5 - rng.uniform(*r)) for r in ranges[2:6])
    tall = style in ("van", "minibus", "ambulance")
    width = min(rng.uniform(1.62, 1.9) + (0.12 if tall or style in ("off-roader", "pickup") else 0.0), 0.49 * length)
    clearance = rng.uniform(0.24, 0.34) if style in ("off-roader", "pickup") else rng.uniform(0.14, 0.22)
    wheel = rng.uniform(0.33, 0.42) if style in ("off-roader", "pickup") or tall else rng.uniform(0.28, 0.36)
    belt = clearance + (rng.uniform(0.66, 0.76) if not tall else rng.uniform(0.8, 1.0))
    if style == "minibus":
        bonnet = belt - rng.uniform(0.0, 0.1)
    else:
        bonnet = belt - rng.uniform(0.1, 0.24)
    overhang = rng.uniform(0.15, 0.2) * length, rng.uniform(0.16, 0.22) * length
    axles = 0.5 * length - max(overhang[0], wheel + 0.2), -0.5 * length + max(overhang[1], wheel + 0.2)
    middle = 0.5 * (roof_start + roof_end)
    doors = int(rng.integers(1, 3)) if style in ("hatchback", "coupe") else 2
    posts = {1: (middle - 0.25,), 2: (middle + 0.25, middle - 0.75)}[doors]
    if style == "minibus":
        posts = tuple(np.linspace(roof_start - 0.8, -0.5 * length + 0.7, 4))
    glazed = -0.5 * length
    if style == "van" and rng.random() < 0.7:
        glazed, posts = roof_start - rng.uniform(0.7, 1.0), ()
    has_box = style == "ambulance" and rng.random() < 0.6
    box = roof_start - rng.uniform(0.9, 1.2) if has_box else -0.5 * length
    if style == "ambulance" and not has_box:
        glazed, posts = roof_start - 0.8, ()
    white = np.array([0.93, 0.93, 0.92])
    bright = np.array([0.85, 0.12, 0.08]) if rng.random() < 0.6 else np.array([0.95, 0.5, 0.05])
    paint = white * rng.uniform(0.92, 1.0) if style == "ambulance" else random_colour(rng)
    second = bright if style == "ambulance" else random_colour(rng)
    stripe = 1 if style == "ambulance" else int(rng.choice(4, p=(0.72, 0.1, 0.08, 0.1)))
    sporty = {"hatchback": 0.3, "coupe": 0.4, "saloon": 0.12, "estate": 0.15}.get(style, 0.0)
    light, ambient, lamp = random_light(rng)
    return Car(
        style=style,
        length=length,
        width=width,
        height=height,
        clearance=clearance,
        belt=belt,
        bonnet=bonnet,
        bonnet_end=bonnet_end,
        roof_start=roof_start,
        roof_end=roof_end,
        rear_foot=rear_foot,
        tail=belt * rng.uniform(*ranges[6]),
        tumble=rng.uniform(0.03, 0.07) if tall else rng.uniform(0.1, 0.2),
        nose=rng.uniform(0.04, 0.16),
        wheel=wheel,
        tyre=rng.uniform(0.18, 0.25),
        axles=axles,
        pillars=posts,
        glazed=glazed,
        spoiler=log_uniform(rng, 0.08, 0.25) if rng.random() < sporty else 0.0,
        beacons=style == "ambulance" or rng.random() < 0.02,
        box=box,
        paint=paint,
        second=second,
        stripe=stripe,
        hub=np.full(3, rng.uniform(0.45, 0.8)) if rng.random() < 0.8 else np.full(3, 0.12),
        light=light,
        ambient=ambient,
        lamp=lamp,
    )
