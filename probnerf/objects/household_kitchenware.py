"""Household kitchenware: pans, pots, teapots, pitchers, stemware, buckets, flasks and lids.

Each function draws one from a generator: metres, the axis is z, it stands on z = 0; a handle is at +x, a spout
at -x. What is closed is solid.
"""

import numpy as np
from jaxtyping import Float

from probnerf.objects.household_parts import (
    Solid,
    arc,
    lathe,
    log_uniform,
    rod,
    rounded_box,
    section_warp,
    smooth,
    superquadric,
    tube,
    union,
    vessel,
)
from probnerf.objects.household_vessels import closed, handle, knob, radius_at


def pan(rng: np.random.Generator) -> Solid:
    """A frying or sauce pan with a long handle."""
    r = log_uniform(rng, 0.045, 0.11)
    h = r * rng.uniform(0.25, 1.1)
    base, wall = r * rng.uniform(0.75, 1.0), rng.uniform(0.002, 0.005)
    outline = smooth([(0.95 * base, 0.0), (base + 0.05 * (r - base), 0.1 * h), (r, 0.95 * h), (r, h)], 20)
    length, rise = r * rng.uniform(0.9, 2.0), rng.uniform(-0.1, 0.35)
    half = rng.uniform(0.004, 0.008)
    start = radius_at(outline, 0.75 * h) - wall - half
    path = smooth([(start, 0.75 * h), (r + 0.3 * length, 0.75 * h + 0.3 * rise * length)], 6)
    bar = smooth([*map(tuple, path[[0, -1]]), (r + length, 0.75 * h + 0.7 * rise * length)], 24)
    widths = half * np.interp(np.linspace(0, 1, 24), [0.0, 0.3, 0.8, 1.0], [1.0, 0.9, 1.5, 1.1])
    parts = [tube(bar, half * rng.uniform(0.5, 1.0), widths * rng.uniform(1.0, 1.8), rng.choice([2.0, 3.5]))]
    return vessel(outline, wall, rng.uniform(0.003, 0.006), None, parts)


def pot(rng: np.random.Generator) -> Solid:
    """A cooking pot with two ears: under a lid with a knob, or open."""
    r = log_uniform(rng, 0.04, 0.13)
    h, wall = r * rng.uniform(0.6, 1.8), rng.uniform(0.002, 0.005)
    belly = rng.uniform(0.95, 1.12)
    outline = smooth([(0.9 * r, 0.0), (0.98 * r, 0.08 * h), (belly * r, 0.5 * h), (r, 0.92 * h), (r, h)], 26)
    z, half = rng.uniform(0.6, 0.85) * h, max(0.0035, 0.05 * r)
    width, reach = rng.uniform(0.3, 0.55) * r, rng.uniform(0.2, 0.4) * r
    arch = arc((radius_at(outline, z), 0.0), (reach, width), -90.0, 90.0, 24)
    inside = [(float(arch[0, 0]) - wall - 0.25 * r, -width), (float(arch[0, 0]) - wall - 0.25 * r, width)]
    arch = np.concatenate([inside[:1], arch, inside[1:]])
    ear = tube(arch, half).rotate((-90.0, 0.0, 0.0)).translate((0.0, 0.0, z))
    ears = [ear, ear.rotate((0.0, 0.0, 180.0))]
    if rng.random() < 0.5:
        return vessel(outline, wall, rng.uniform(0.003, 0.006), None, ears)
    rise = rng.uniform(0.08, 0.35) * r
    lid = smooth([(1.03 * r, h - 0.004), (1.03 * r, h + 0.003), (0.6 * r, h + 0.75 * rise), (0.02 * r, h + rise)], 20)
    return closed(outline, None, [*ears, lathe(lid), knob(rng, h + rise, rng.uniform(0.15, 0.3) * r)])


def teapot(rng: np.random.Generator) -> Solid:
    """A teapot, kettle or watering can: belly, spout, handle behind or above, lid."""
    r = log_uniform(rng, 0.035, 0.09)
    h = r * rng.uniform(1.0, 2.2)
    mouth, base, level = rng.uniform(0.35, 0.75) * r, rng.uniform(0.55, 0.95) * r, rng.uniform(0.3, 0.6)
    outline = smooth([(0.95 * base, 0.0), (base, 0.04 * h), (r, level * h), (mouth, 0.97 * h), (mouth, h)], 34)
    wall, half = rng.uniform(0.002, 0.004), rng.uniform(0.004, 0.0075)
    z, tip = rng.uniform(0.2, 0.5) * h, rng.uniform(0.8, 1.15) * h
    foot, reach = radius_at(outline, z), rng.uniform(0.6, 1.2) * r
    sway = rng.uniform(0.3, 0.7)
    start, middle = (-foot + 0.35 * r, z - 0.05 * h), (-foot - sway * reach, z + 0.45 * (tip - z))
    end = (-foot - 0.85 * reach, tip - 0.05 * h)
    spine = smooth([start, (-foot, z), middle, end, (-foot - reach, tip)], 24)
    thick = np.linspace(rng.uniform(0.16, 0.28) * r, max(0.005, 0.09 * r), 24)
    bored = np.concatenate([spine, spine[-1:] + (spine[-1] - spine[-2])])
    bore = np.append(thick, thick[-1]) - min(wall, 0.35 * thick[-1])
    extras, bores = [tube(spine, thick)], [tube(bored, bore)]
    if rng.random() < 0.7:
        extras.append(handle(rng, outline, 0.2 * h, 0.82 * h, rng.uniform(0.45, 0.75) * r, half, wall + half))
    else:
        side = radius_at(outline, 0.8 * h)
        extras.append(tube(arc((0.0, 0.8 * h), (side, rng.uniform(0.7, 1.1) * r + 0.2 * h), 0.0, 180.0, 28), half))
    if rng.random() < 0.3:
        return vessel(outline, wall, 0.004, None, extras, bores)
    rise = rng.uniform(0.1, 0.5) * mouth
    lid = smooth([(1.05 * mouth, 0.985 * h), (1.0 * mouth, h + 0.1 * rise), (0.6 * mouth, h + 0.7 * rise)], 12)
    lid = np.concatenate([lid, [(0.02 * mouth, h + rise)]])
    extras += [lathe(lid), knob(rng, h + rise, rng.uniform(0.12, 0.22) * r)]
    return closed(outline, None, extras) - tube(bored[-6:], bore[-6:])


def pitcher(rng: np.random.Generator) -> Solid:
    """A jug with a lip at -x and a handle."""
    r = log_uniform(rng, 0.03, 0.075)
    h = r * rng.uniform(1.8, 3.6)
    base, neck = rng.uniform(0.6, 1.0) * r, rng.uniform(0.6, 1.0) * r
    level, top = rng.uniform(0.25, 0.5) * h, rng.uniform(0.95, 1.2) * neck
    outline = smooth([(0.95 * base, 0.0), (base, 0.04 * h), (r, level), (neck, 0.8 * h), (top, h)], 32)
    wall, half, pull = rng.uniform(0.002, 0.005), rng.uniform(0.004, 0.008), rng.uniform(0.2, 0.5) * r

    def warp(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        away = np.arctan2(p[:, 1], -p[:, 0])
        amount = np.clip((p[:, 2] / h - 0.7) / 0.3, 0.0, 1.0) ** 2 * np.exp(-((away / 0.45) ** 2))
        radius = np.linalg.norm(p[:, :2], axis=1) / top
        return p - np.stack([pull * amount * radius, np.zeros(len(p)), np.zeros(len(p))], axis=1)

    grip = handle(rng, outline, 0.25 * h, 0.85 * h, rng.uniform(0.4, 0.8) * r, half, wall + half)
    return vessel(outline, wall, 0.005, warp, [grip])


def stemware(rng: np.random.Generator) -> Solid:
    """A wine glass, goblet or egg cup: foot, stem, and a thin bowl."""
    r = log_uniform(rng, 0.022, 0.052)
    bowl_height, stem = r * rng.uniform(1.2, 3.0), r * rng.uniform(0.5, 2.6)
    thin, foot, top = max(0.0035, 0.1 * r), rng.uniform(0.75, 1.05) * r, rng.uniform(0.65, 1.05) * r
    wall = rng.uniform(0.0015, 0.0025)
    knots = [(foot, 0.0), (foot, 0.002), (0.35 * foot, 0.08 * r + 0.003), (thin, 0.25 * r), (thin, 0.25 * r + stem)]
    start = 0.25 * r + stem
    knots += [(0.65 * r, start + 0.14 * bowl_height), (r, start + 0.45 * bowl_height), (top, start + bowl_height)]
    return vessel(smooth(knots, 44), wall, start + 0.02 * bowl_height + wall)


def bucket(rng: np.random.Generator) -> Solid:
    """A bucket or basket with an arch over its mouth."""
    r = log_uniform(rng, 0.035, 0.12)
    h, base, wall = r * rng.uniform(0.8, 1.8), rng.uniform(0.65, 1.0), rng.uniform(0.002, 0.005)
    outline = smooth([(base * r, 0.0), (0.5 * (1.0 + base) * r, 0.5 * h), (r, h)], 16)
    half = rng.uniform(0.0025, 0.006)
    arch = arc((0.0, 0.9 * h), (r - 0.3 * wall, rng.uniform(0.7, 1.4) * r), 0.0, 180.0, 32)
    body = vessel(outline, wall, wall, section_warp(rng, 0.6, even=True))
    return union([body, tube(arch, half, half * rng.uniform(1.0, 2.5), 3.0)])


def flask(rng: np.random.Generator) -> Solid:
    """A thermos, shaker or flask: a lathe of steps, with a cup or loop on top."""
    h = log_uniform(rng, 0.1, 0.32)
    r = h * rng.uniform(0.12, 0.22)
    parts, z = [], 0.0
    for share in rng.dirichlet([6.0, 2.0, 2.0]):
        width, height = r * rng.uniform(0.72, 1.0), share * h
        parts.append(
            lathe(
                np.asarray(
                    [(0.96 * width, z), (width, z + 0.002), (width, z + height), (0.9 * width, z + height + 0.003)]
                )
            )
        )
        z += height
    if rng.random() < 0.5:
        loop = arc((0.0, z), (0.6 * r, 0.7 * r), 0.0, 180.0, 24)
        parts.append(tube(loop, 0.09 * r + 0.001, 0.2 * r, 3.0))
    else:
        parts.append(superquadric((0.55 * r, 0.55 * r, 0.4 * r), 0.5).translate((0.0, 0.0, z)))
        if rng.random() < 0.3:
            parts.append(rod(0.1 * r, -0.2 * r, 0.9 * r).translate((0.0, 0.0, z + 0.2 * r)))
    if rng.random() < 0.25:
        parts.append(rounded_box((0.5 * r, 0.7 * r, 0.6 * h), 0.1 * r).translate((0.85 * r, 0.0, 0.15 * h)))
    return union(parts)


def lid(rng: np.random.Generator) -> Solid:
    """A lid with a knob, domed or flat, hollow underneath or solid; or a screw cap."""
    r = log_uniform(rng, 0.018, 0.14)
    rise, rim = r * rng.uniform(0.02, 0.5), max(0.003, 0.05 * r)
    outline = smooth(
        [(r, 0.0), (r, rim), (0.75 * r, rim + 0.6 * rise), (0.3 * r, rim + 0.95 * rise), (0.01 * r, rim + rise)], 24
    )
    body = lathe(outline)
    if rng.random() < 0.6:
        wall = rng.uniform(0.0015, 0.004)
        hollow = smooth(
            [
                (r - wall, -0.01),
                (r - wall, rim - wall),
                (0.75 * r - wall, rim + 0.6 * rise - wall),
                (0.01 * r, rim + rise - wall),
            ],
            20,
        )
        body -= lathe(hollow)
    if rng.random() < 0.8:
        body += knob(rng, rim + rise, float(np.clip(rng.uniform(0.15, 0.35) * r, 0.006, 0.03)))
    return body
