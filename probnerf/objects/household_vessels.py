"""Household vessels: cans, bottles, mugs, pots, teapots, glasses and vases, with true walls.

Each function draws one from a generator: metres, the body's axis is z, it stands on z = 0; a handle is at +x, a spout
at -x. What is closed is solid.
"""

import numpy as np
from jaxtyping import Float

from probnerf.objects.household_parts import (
    Solid,
    Warp,
    arc,
    capsule,
    lathe,
    log_uniform,
    plate,
    section_warp,
    smooth,
    stroke,
    tube,
    union,
    vessel,
)

Outline = Float[np.ndarray, "n 2"]


def radius_at(outline: Outline, z: float) -> float:
    """The outline's radius at height z."""
    order = np.argsort(outline[:, 1], kind="stable")
    return float(np.interp(z, outline[order, 1], outline[order, 0]))


def closed(outline: Outline, warp: Warp | None, extras: list[Solid]) -> Solid:
    """A vessel that is solid, with its handles, lids and spouts."""
    return union([lathe(outline, warp), *extras])


def handle(
    rng: np.random.Generator, outline: Outline, low: float, high: float, reach: float, half: float, inset: float
) -> Solid:
    """A handle at +x between the heights `low` and `high`: round, D-shaped, square or like an ear.

    reach: how far its centre line stands off the body. half: half its thickness. inset: how deep its ends go.
    """
    style = rng.choice(["round", "d", "square", "ear"])
    flatness = rng.uniform(1.0, 2.2)
    power = {"round": 1.0, "d": 0.6, "square": 0.3, "ear": 1.0}[style]
    angle = np.radians(np.linspace(90.0, -90.0, 33))
    c, s = np.cos(angle), np.sin(angle)
    out = np.abs(c) ** power * (1.0 + (0.45 * s if style == "ear" else 0.0))
    z = (low + high) / 2.0 + (high - low) / 2.0 * np.sign(s) * np.abs(s) ** power
    foot = np.asarray([radius_at(outline, v) for v in (high, low)])
    base = foot[1] + (foot[0] - foot[1]) * (z - low) / (high - low)
    path = np.stack([base + reach * out, z], axis=1)
    path = np.concatenate([[[foot[0] - inset, high]], path, [[foot[1] - inset, low]]])
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    even = np.linspace(0.0, chord[-1], 30)
    path = np.stack([np.interp(even, chord, path[:, 0]), np.interp(even, chord, path[:, 1])], axis=1)
    if style == "square":
        return plate(stroke(path, half), 2.0 * half * flatness, upright=True)
    return tube(path, half, half * flatness, rng.choice([2.0, 4.0]))


def knob(rng: np.random.Generator, z: float, size: float) -> Solid:
    """A knob for a lid that stands on height z: a ball, a mushroom, a cylinder or a loop; `size` is its height."""
    style = rng.integers(4)
    if style == 0:
        return Solid.sphere(0.6 * size, 32).translate((0.0, 0.0, z + 0.5 * size))
    if style == 1:
        shape = smooth([(0.3, -0.3), (0.25, 0.2), (0.65, 0.6), (0.6, 0.85), (0.02, 1.0)], 16)
        return lathe(shape * size + [0.0, z])
    if style == 2:
        return Solid.cylinder(1.2 * size, 0.5 * size, 0.6 * size, 40).translate((0.0, 0.0, z - 0.2 * size))
    return tube(arc((0.0, z - 0.2 * size), (1.1 * size, 1.1 * size), 0.0, 180.0), 0.25 * size)


def can(rng: np.random.Generator) -> Solid:
    """A tin can: flat or tall, with rims, ribs, a neck or the cap of a spray; sometimes opened."""
    r = log_uniform(rng, 0.022, 0.055)
    h = float(np.clip(r * log_uniform(rng, 0.8, 5.0), 0.03, 0.28))
    bead, style = 0.04 * r + 0.0005, rng.choice(["food", "drink", "spray", "open"], p=[0.45, 0.25, 0.15, 0.15])
    if style == "drink":
        neck = r * rng.uniform(0.75, 0.9)
        outline = smooth([(0.78 * r, 0.0), (r, 0.07 * h), (r, 0.5 * h), (r, 0.87 * h), (neck, 0.97 * h), (neck, h)], 40)
        return lathe(outline) - Solid.cylinder(0.1, neck - 0.002, -1.0, 48).translate((0.0, 0.0, h - 0.04 * r - 0.002))
    side = np.stack([np.full(40, r - bead), np.linspace(2.0 * bead, h - 2.0 * bead, 40)], axis=1)
    if rng.random() < 0.4:
        middle = (side[:, 1] > 0.25 * h) & (side[:, 1] < 0.75 * h)
        side[:, 0] -= middle * 0.015 * r * (1.0 - np.cos(2.0 * np.pi * side[:, 1] / max(0.05 * h, 0.006)))
    base = [(r, 0.0), (r, 1.6 * bead)]
    if style == "spray":
        cap, top = r * rng.uniform(0.55, 1.02), h * rng.uniform(0.12, 0.3)
        shoulder = smooth([(r, h), (0.85 * r, h + 0.25 * r), (min(cap, 0.85 * r), h + 0.4 * r)], 10)
        lid = [(cap, h + 0.2 * r), (cap, h + 0.3 * r + top), (0.85 * cap, h + 0.36 * r + top)]
        body = lathe(np.concatenate([base, side, [(r, h - 1.6 * bead)], shoulder]))
        return union([body, lathe(np.asarray(lid))])
    outline = np.concatenate([base, side, [(r, h - 1.6 * bead), (r, h)]])
    if style == "open":
        return vessel(outline, max(0.0015, 1.6 * bead), 0.003)
    recess = Solid.cylinder(0.1, r - 1.5 * bead, -1.0, 48)
    return lathe(outline) - recess.translate((0.0, 0.0, h - rng.uniform(0.001, 0.004)))


def bottle(rng: np.random.Generator) -> Solid:
    """A bottle: drink, wine, sauce, detergent with a handle, or soap with a pump; round or not; closed or open."""
    h = log_uniform(rng, 0.07, 0.33)
    r = h * rng.uniform(0.11, 0.24)
    neck = max(r * rng.uniform(0.25, 0.6), 0.006)
    shoulder, start = rng.uniform(0.45, 0.8) * h, rng.uniform(0.72, 0.93) * h
    shoulder = min(shoulder, start - 0.05 * h)
    waist = rng.uniform(0.78, 1.0) if rng.random() < 0.35 else 1.0
    between = shoulder + rng.uniform(0.35, 0.65) * (start - shoulder)
    knots = [(0.9 * r, 0.0), (r, 0.04 * h), (r, 0.3 * shoulder), (waist * r, 0.55 * shoulder), (r, 0.85 * shoulder)]
    outline = smooth([*knots, (r, shoulder), (0.5 * (r + neck), between), (neck, start), (neck, h)], 44)
    warp = section_warp(rng, 0.6, even=True)
    extras = []
    if h > 0.15 and rng.random() < 0.15:
        half = 0.025 * h + 0.002
        extras.append(handle(rng, outline, 0.5 * shoulder, 0.95 * shoulder, 0.45 * r, half, 2.0 * half))
    if rng.random() < 0.3 and neck > 0.009:
        return vessel(outline, rng.uniform(0.0015, min(0.004, 0.35 * neck)), 0.005, warp, extras)
    top = rng.choice(["cap", "pump", "nozzle"], p=[0.7, 0.15, 0.15])
    wide = neck * rng.uniform(1.05, 1.4)
    low = h - rng.uniform(0.3, 0.95) * (h - start)
    if top == "cap":
        extras.append(Solid.cylinder(h + 0.02 * h - low, wide, wide * rng.uniform(0.8, 1.0), 40).translate((0, 0, low)))
    elif top == "nozzle":
        extras.append(Solid.cylinder(0.18 * h, wide, 0.25 * wide, 40).translate((0.0, 0.0, h - 0.02 * h)))
    else:
        stem, reach = max(0.2 * neck, 0.0025), rng.uniform(0.7, 1.3) * r
        extras += [
            Solid.cylinder(0.06 * h, wide, -1.0, 40).translate((0.0, 0.0, h - 0.03 * h)),
            Solid.cylinder(0.16 * h, stem, -1.0, 24).translate((0.0, 0.0, h)),
            capsule((0.0, 0.0, 1.14 * h), (-reach, 0.0, 1.12 * h), max(0.012 * h, stem * 1.2)),
        ]
    return closed(outline, warp, extras)


def jar(rng: np.random.Generator) -> Solid:
    """A jar with a wide mouth: under a lid, or open."""
    r = log_uniform(rng, 0.02, 0.07)
    h = r * rng.uniform(1.2, 3.6)
    mouth = r * rng.uniform(0.6, 0.97)
    belly = rng.uniform(0.9, 1.0)
    knots = [(0.88 * r, 0.0), (r, 0.06 * h), (r, 0.35 * h), (belly * r, 0.6 * h), (belly * r, 0.78 * h)]
    outline = smooth([*knots, (mouth, 0.9 * h), (mouth, h)], 36)
    warp = section_warp(rng, 0.6) if mouth < 0.9 * r else None
    if rng.random() < 0.35:
        return vessel(outline, rng.uniform(0.002, 0.005), 0.006, warp)
    wide = mouth * rng.uniform(1.02, 1.12)
    lid = [Solid.cylinder(rng.uniform(0.1, 0.2) * h, wide, -1.0, 48).translate((0.0, 0.0, 0.92 * h))]
    if rng.random() < 0.3:
        lid.append(knob(rng, 1.02 * h, 0.3 * mouth))
    return closed(outline, warp, lid)


def mug(rng: np.random.Generator) -> Solid:
    """A mug or cup: straight, tapered or bellied, with no handle, one, or two."""
    r = log_uniform(rng, 0.026, 0.055)
    h = r * rng.uniform(1.1, 3.0)
    base, belly = rng.uniform(0.5, 1.05), rng.uniform(0.85, 1.12)
    outline = smooth([(0.92 * base * r, 0.0), (base * r, 0.05 * h), (belly * r, 0.5 * h), (r, 0.9 * h), (r, h)], 26)
    wall = rng.uniform(0.0018, 0.0055)
    warp = section_warp(rng, 0.8, even=True)
    half, reach = rng.uniform(0.003, 0.006), rng.uniform(0.016, 0.036)
    low, high = rng.uniform(0.12, 0.3) * h, rng.uniform(0.75, 0.92) * h
    if high - low < 0.02 + 2.0 * half:
        low, high = max(half, high - 0.02 - 2.0 * half), max(high, 0.021 + 3.0 * half)
    count = rng.choice([0, 1, 2], p=[0.15, 0.75, 0.1])
    ear = handle(rng, outline, low, min(high, h - half), reach, half, wall + half)
    ears = [ear.rotate((0.0, 0.0, 180.0 * i)) for i in range(count)]
    return vessel(outline, wall, rng.uniform(0.003, 0.008), warp, ears)


def bowl(rng: np.random.Generator) -> Solid:
    """A bowl, shallow or deep, on a foot or flat."""
    r = log_uniform(rng, 0.04, 0.15)
    h, power = r * rng.uniform(0.3, 1.0), rng.uniform(1.4, 4.0)
    foot = rng.uniform(0.3, 0.6) * r
    s = np.linspace(0.0, 1.0, 26)
    side = np.stack([foot + (r - foot) * (1.0 - (1.0 - s) ** power) ** (1.0 / power), 0.06 * h + 0.94 * h * s], axis=1)
    outline = np.concatenate([[(foot, 0.0)], side])
    wall = rng.uniform(0.002, 0.006)
    body = vessel(outline, wall, 0.06 * h + wall, section_warp(rng, 0.75))
    if rng.random() < 0.3:
        body -= Solid.cylinder(0.04 * h + 0.001, foot - wall, -1.0, 48).translate((0.0, 0.0, -0.001))
    return body


def dish(rng: np.random.Generator) -> Solid:
    """A plate or saucer with a rim; some are square or oval."""
    r = log_uniform(rng, 0.05, 0.16)
    h, well = rng.uniform(0.1, 0.22) * r, rng.uniform(0.5, 0.75) * r
    outline = smooth([(well, 0.0), (well + 0.12 * r, 0.4 * h), (0.5 * (well + r) + 0.05 * r, 0.75 * h), (r, h)], 20)
    wall = rng.uniform(0.0025, 0.005)
    return vessel(outline, wall, wall, section_warp(rng, 0.7))


def vase(rng: np.random.Generator) -> Solid:
    """A vase with a free lathe profile through random knots: open with a wall or closed, some with two handles."""
    h = log_uniform(rng, 0.05, 0.33)
    wide = h * log_uniform(rng, 0.12, 0.5)
    count = int(rng.integers(4, 8))
    radii = wide * rng.uniform(0.3, 1.0, count)
    radii = np.maximum(radii * wide / radii.max(), 0.009)
    heights = np.concatenate([[0.0], np.sort(rng.uniform(0.08, 0.94, count - 2)), [1.0]])
    heights = h * (0.6 * heights + 0.4 * np.linspace(0.0, 1.0, count))
    outline = smooth(list(zip(radii, heights, strict=True)), 44)
    wall = rng.uniform(0.0015, min(0.006, 0.4 * float(radii.min())))
    warp = section_warp(rng, 0.55, even=True)
    ears = []
    if rng.random() < 0.2:
        half, reach = 0.02 * h + 0.001, rng.uniform(0.25, 0.6) * wide
        ear = handle(rng, outline, rng.uniform(0.3, 0.5) * h, rng.uniform(0.7, 0.9) * h, reach, half, wall + half)
        ears = [ear, ear.rotate((0.0, 0.0, 180.0))]
    if rng.random() < 0.2:
        return closed(outline, warp, ears)
    return vessel(outline, wall, rng.uniform(1.0, 2.0) * wall, warp, ears)
