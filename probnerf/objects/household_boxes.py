"""Household boxes: cartons, trays, boxes under a lid, books, tins, bricks.

Each function draws one from a generator: metres, centred on the z axis, standing on z = 0.
"""

import numpy as np

from probnerf.objects.household_parts import (
    Solid,
    disc,
    lathe,
    log_uniform,
    plate,
    rectangle,
    rod,
    rounded_box,
    section_warp,
    superquadric,
    union,
)

Size = tuple[float, float, float]


def _size(rng: np.random.Generator, low: float, high: float, flattest: float = 0.15) -> Size:
    """Three sides in any order: the longest log-uniform, the others uniform shares of it."""
    sides = log_uniform(rng, low, high) * np.asarray([1.0, rng.uniform(0.35, 1.0), rng.uniform(flattest, 0.9)])
    x, y, z = rng.permutation(sides)
    return float(x), float(y), float(z)


def chamfered_box(rng: np.random.Generator) -> Solid:
    """A box with chamfered or sharp edges."""
    size = _size(rng, 0.03, 0.33)
    return rounded_box(size, rng.uniform(0.0, 0.12) * min(size), chamfered=True)


def smooth_box(rng: np.random.Generator) -> Solid:
    """A box with rounded edges, up to a bar of soap."""
    size = _size(rng, 0.03, 0.3)
    if rng.random() < 0.3:
        return superquadric([0.5 * s for s in size], rng.uniform(0.15, 0.6), rng.uniform(0.15, 0.6))
    return rounded_box(size, rng.uniform(0.03, 0.4) * min(size))


def tapered_box(rng: np.random.Generator) -> Solid:
    """A box that narrows or widens upwards, closed or as an open bin."""
    size = _size(rng, 0.04, 0.3)
    rounding, taper = rng.uniform(0.01, 0.2) * min(size), rng.uniform(0.55, 0.95)
    if rng.random() < 0.5:
        return rounded_box(size, rounding, rng.random() < 0.5, taper)
    taper, wall = 1.0 / rng.uniform(0.65, 0.95), rng.uniform(0.0015, 0.005)
    return _hollow(size, wall, min(rounding, 0.2 * size[2]), taper)


def _hollow(size: Size, wall: float, rounding: float, taper: float = 1.0) -> Solid:
    """An open box of walls; the cavity's edges are rounded, too."""
    x, y, z = size
    outer = rounded_box((x, y, 2.0 * z), rounding, taper=2.0 * taper - 1.0).trim_by_plane((0.0, 0.0, -1.0), -z)
    inner = (x - 2.0 * wall, y - 2.0 * wall, 2.0 * z)
    grown = 1.0 + 2.0 * (taper - 1.0) * x / inner[0]
    return outer - rounded_box(inner, max(rounding - wall, 0.0), taper=grown).translate((0.0, 0.0, wall))


def tray(rng: np.random.Generator) -> Solid:
    """An open box or tray with walls, sometimes with compartments or slots for hands."""
    x, y = log_uniform(rng, 0.06, 0.34), rng.uniform(0.4, 1.0)
    size = (x, x * y, x * log_uniform(rng, 0.08, 0.7))
    wall = rng.uniform(0.0015, 0.006)
    solid = _hollow(size, wall, rng.uniform(0.0, 0.4) * min(size), 1.0 / rng.uniform(0.8, 1.0))
    if rng.random() < 0.3:
        height = rng.uniform(0.5, 0.95) * size[2]
        for i in range(1, int(rng.integers(2, 4))):
            place = (i / 3.0 - 0.5) * x
            divider = rounded_box((wall, size[1] - wall, height)).translate((place, 0.0, 0.0))
            solid += divider ^ solid.hull()
    if rng.random() < 0.3:
        slot = rounded_box((2.0 * x, 0.35 * size[1], 0.2 * size[2]), 0.08 * size[2])
        solid -= slot.translate((0.0, 0.0, 0.6 * size[2]))
    return solid


def lidded_box(rng: np.random.Generator) -> Solid:
    """A box of walls whose lid stands open by some angle about an edge, or lies on it as a solid's."""
    x = log_uniform(rng, 0.04, 0.25)
    size = (x, x * rng.uniform(0.5, 1.0), x * rng.uniform(0.25, 0.8))
    wall = rng.uniform(0.002, 0.005)
    depth = max(rng.uniform(0.1, 0.35) * size[2], 2.0 * wall)
    lid = _hollow((x + 2.0 * wall, size[1] + 2.0 * wall, depth), wall, 0.0).rotate((180.0, 0.0, 0.0))
    if rng.random() < 0.4:
        closed = rounded_box((x + 2.0 * wall, size[1] + 2.0 * wall, depth), 0.5 * wall)
        return rounded_box(size, 0.5 * wall) + closed.translate((0.0, 0.0, size[2] + wall - depth))
    angle = rng.uniform(4.0, 110.0)
    hinged = lid.translate((0.0, -0.5 * size[1], depth)).rotate((-angle, 0.0, 0.0))
    hinged = hinged.translate((0.0, 0.5 * size[1], size[2] - depth + wall))
    hinge = rod(1.3 * wall, -0.4 * x, 0.4 * x).translate((0.0, 0.5 * size[1], size[2] - depth + wall))
    return union([_hollow(size, wall, 0.0), hinged, hinge])


def book(rng: np.random.Generator) -> Solid:
    """A closed book lying: covers, spine and a block of pages set back."""
    y = log_uniform(rng, 0.08, 0.32)
    x, z = y * rng.uniform(0.6, 0.9), y * log_uniform(rng, 0.04, 0.3)
    cover, setback = rng.uniform(0.0008, 0.003), rng.uniform(0.0015, 0.006)
    sheet = rounded_box((x, y, cover))
    pages = rounded_box((x - setback, y - 2.0 * setback, z - cover)).translate((-0.5 * setback, 0.0, 0.5 * cover))
    if rng.random() < 0.5:
        spine = Solid.cylinder(y, 0.5 * z, -1.0, 32).rotate((90.0, 0.0, 0.0)).translate((0.0, 0.5 * y, 0.5 * z))
        spine = spine.scale((min(1.0, 0.01 / z), 1.0, 1.0)).translate((-0.5 * x, 0.0, 0.0))
    else:
        spine = rounded_box((cover, y, z)).translate((0.5 * (cover - x), 0.0, 0.0))
    return union([sheet, sheet.translate((0.0, 0.0, z - cover)), pages, spine])


def gable_carton(rng: np.random.Generator) -> Solid:
    """A carton of milk or juice: a prism with a gable roof, a fin, sometimes a cap."""
    x = log_uniform(rng, 0.04, 0.1)
    y, z = x * rng.uniform(0.75, 1.1), x * rng.uniform(1.0, 2.4)
    roof, fin, thick = x * rng.uniform(0.3, 0.6), x * rng.uniform(0.1, 0.25), rng.uniform(0.002, 0.004)
    ends = [(s * x / 2.0, t * y / 2.0, v) for s in (-1, 1) for t in (-1, 1) for v in (0.0, z)]
    ridge = [(s * thick / 2.0, t * y / 2.0, z + roof) for s in (-1, 1) for t in (-1, 1)]
    top = rounded_box((thick, y, fin + 0.2 * roof)).translate((0.0, 0.0, z + 0.8 * roof))
    parts = [Solid.hull_points(np.asarray(ends + ridge)), top]
    if rng.random() < 0.6:
        cap, tilt = x * rng.uniform(0.12, 0.22), float(np.degrees(np.arctan2(roof, x / 2.0)))
        screw = Solid.cylinder(rng.uniform(1.0, 2.2) * cap, cap, -1.0, 32).translate((0.0, 0.0, -0.3 * cap))
        parts.append(screw.rotate((0.0, tilt, 0.0)).translate((x / 4.0, 0.0, z + roof / 2.0)))
    return union(parts)


def brick(rng: np.random.Generator) -> Solid:
    """A brick with holes, a sponge with a scouring layer, a toy brick with studs, or a block of wood."""
    x, y, z = sorted(_size(rng, 0.04, 0.22, 0.25), reverse=True)
    style = rng.integers(4)
    body = rounded_box((x, y, z), rng.uniform(0.02, 0.15) * z)
    if style == 0:
        count, r = int(rng.integers(2, 5)), 0.2 * min(y, x / 4.0)
        holes = [
            Solid.cylinder(3.0 * z, r, -1.0, 24, True).translate((x * ((i + 0.5) / count - 0.5), 0.0, 0.0))
            for i in range(count)
        ]
        return body - union(holes)
    if style == 1:
        return body + rounded_box((1.02 * x, 1.02 * y, 0.25 * z), 0.03 * z).translate((0.0, 0.0, 0.75 * z))
    if style == 2:
        columns, rows = int(rng.integers(2, 5)), 2
        stud = Solid.cylinder(0.35 * z, 0.3 * min(x / columns, y / rows), -1.0, 24)
        places = [
            (x * ((i + 0.5) / columns - 0.5), y * ((j + 0.5) / rows - 0.5)) for i in range(columns) for j in range(rows)
        ]
        return union([body, *(stud.translate((*place, 0.95 * z)) for place in places)])
    return rounded_box((x, y, z), 0.02 * z, chamfered=True)


def tin(rng: np.random.Generator) -> Solid:
    """A tin of biscuits, tea or sweets: rectangular, oval, round or polygonal, its lid a little wider."""
    r = log_uniform(rng, 0.02, 0.12)
    h = r * rng.uniform(0.3, 2.2)
    step, split = rng.uniform(0.0005, 0.002), rng.uniform(0.5, 0.9) * h
    if rng.random() < 0.5:
        warp = section_warp(rng, 0.1)
        body = lathe(
            np.asarray([(r, 0.0), (r, split), (r + step, split), (r + step, h - 0.02 * r), (0.97 * r, h)]), warp
        )
    else:
        y, corner = r * rng.uniform(0.5, 1.0), rng.uniform(0.1, 0.45)
        base = rectangle((-r, -y), (r, y), corner * y)
        lid = plate(base.offset(step), h - split).translate((0.0, 0.0, 0.5 * (h + split)))
        body = plate(base, h).translate((0.0, 0.0, 0.5 * h)) + lid
    return body


def tissue_box(rng: np.random.Generator) -> Solid:
    """A box of thin walls with an oval opening on top."""
    x = log_uniform(rng, 0.09, 0.26)
    y, z = x * rng.uniform(0.45, 1.0), x * rng.uniform(0.25, 0.7)
    wall = rng.uniform(0.0015, 0.003)
    cavity = rounded_box((x - 2.0 * wall, y - 2.0 * wall, z - 2.0 * wall)).translate((0.0, 0.0, wall))
    opening = plate(disc(1.0), 1.0).scale((rng.uniform(0.2, 0.4) * x, rng.uniform(0.12, 0.35) * y, z))
    return rounded_box((x, y, z), 0.5 * wall) - cavity - opening.translate((0.0, 0.0, z))


def multipack(rng: np.random.Generator) -> Solid:
    """A package of several boxes or rolls side by side in one wrapper."""
    size = _size(rng, 0.03, 0.11, 0.4)
    columns, rows = int(rng.integers(2, 4)), int(rng.integers(1, 3))
    box = rng.random() < 0.5
    unit = (
        rounded_box(size, 0.06 * min(size))
        if box
        else rod(0.5 * size[1], -0.5 * size[0], 0.5 * size[0]).translate((0, 0, 0.5 * size[1]))
    )
    pitch = 0.99 * size[1]
    level = 0.99 * (size[2] if box else size[1])
    return union([unit.translate((0.0, pitch * i, level * j)) for i in range(columns) for j in range(rows)])
