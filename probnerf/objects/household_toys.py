"""Fruit, toys, figures, shoes and turned stands: things put together from superquadrics, capsules and lathes.

Each function draws one from a generator: metres, z up; what has a front has it at +x.
"""

import numpy as np
from jaxtyping import Float

from probnerf.objects.household_parts import (
    Solid,
    arc,
    bent,
    capsule,
    lathe,
    log_uniform,
    lumpy,
    plate,
    rod,
    rounded_box,
    section_warp,
    smooth,
    superquadric,
    tube,
    union,
)
from probnerf.objects.household_vessels import knob


def round_fruit(rng: np.random.Generator) -> Solid:
    """An apple, pear, lemon, tomato, pumpkin or egg."""
    style = rng.choice(["apple", "pear", "lemon", "pumpkin", "egg"])
    radii = {"apple": (0.02, 0.05), "pear": (0.025, 0.045), "lemon": (0.016, 0.04), "pumpkin": (0.025, 0.11)}
    r = log_uniform(rng, *radii.get(style, (0.017, 0.033)))
    dent = rng.uniform(0.1, 0.3)
    knots = {
        "apple": [
            (0.02, dent * 0.6),
            (0.35, 0.0),
            (0.85, 0.45),
            (1.0, 1.0),
            (0.8, 1.6),
            (0.4, 1.8),
            (0.02, 1.75 - dent),
        ],
        "pear": [(0.02, 0.1), (0.4, 0.0), (0.95, 0.55), (1.0, 1.0), (0.65, 1.7), (0.42, 2.2), (0.3, 2.5), (0.02, 2.6)],
        "lemon": [(0.02, -0.35), (0.18, -0.25), (0.6, 0.1), (1.0, 1.0), (0.6, 1.9), (0.18, 2.25), (0.02, 2.35)],
        "pumpkin": [(0.02, 0.15), (0.5, 0.0), (0.95, 0.4), (1.0, 0.7), (0.85, 1.1), (0.4, 1.3), (0.02, 1.1)],
        "egg": [(0.02, 0.0), (0.6, 0.2), (1.0, 1.0), (0.78, 1.8), (0.4, 2.3), (0.02, 2.5)],
    }[style]
    outline = smooth(knots, 40) * r
    flutes, depth = int(rng.integers(5, 10)), rng.uniform(0.04, 0.1)

    def ribbed(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return p * np.stack(
            [1.0 + depth * np.cos(flutes * np.arctan2(p[:, 1], p[:, 0]))] * 2 + [np.ones(len(p))], axis=1
        )

    fruit = lathe(outline, ribbed if style == "pumpkin" else None)
    if style in ("apple", "pear", "pumpkin") and rng.random() < 0.7:
        top = float(outline[-1, 1])
        stem = capsule(
            (0.0, 0.0, top - 0.1 * r), (0.15 * r, 0.1 * r, top + rng.uniform(0.25, 0.6) * r), 0.06 * r + 0.0006
        )
        fruit += stem
    return lumpy(fruit, rng, 0.02)


def long_fruit(rng: np.random.Generator) -> Solid:
    """A banana, carrot, cucumber, sausage or aubergine lying."""
    length = log_uniform(rng, 0.07, 0.28)
    r, style = length * rng.uniform(0.07, 0.13), rng.choice(["banana", "carrot", "cucumber"])
    shares = {
        "banana": [
            (0.25, 0.0),
            (0.5, 0.05),
            (0.95, 0.25),
            (1.0, 0.5),
            (0.85, 0.75),
            (0.35, 0.9),
            (0.25, 0.99),
            (0.02, 1.0),
        ],
        "carrot": [(0.02, 0.0), (0.15, 0.05), (0.6, 0.4), (0.95, 0.8), (0.9, 0.96), (0.3, 1.0)],
        "cucumber": [(0.02, 0.0), (0.5, 0.02), (0.9, 0.12), (1.0, 0.5), (0.85, 0.85), (0.4, 0.98), (0.02, 1.0)],
    }[style]
    outline = smooth([(a * r, b * length) for a, b in shares], 48)
    body = lathe(outline).rotate((0.0, 90.0, 0.0)).translate((-0.5 * length, 0.0, 0.0)).rotate((90.0, 0.0, 0.0))
    angle = rng.uniform(0.6, 1.5) if style == "banana" else rng.uniform(0.0, 0.3)
    curved = bent(body, angle / length, 0.02).rotate((90.0, 0.0, 0.0))
    return lumpy(curved, rng, 0.012)


def ball(rng: np.random.Generator) -> Solid:
    """A ball, dice-like round cube, rugby ball or stone."""
    r = log_uniform(rng, 0.016, 0.12)
    shape = r * np.asarray([1.0, 1.0, 1.0] if rng.random() < 0.5 else rng.uniform(0.5, 1.0, 3))
    solid = superquadric(shape, rng.uniform(0.7, 1.1) if rng.random() < 0.4 else 1.0, 1.0, 56)
    return lumpy(solid, rng, rng.uniform(0.02, 0.06)) if rng.random() < 0.3 else solid


def animal(rng: np.random.Generator) -> Solid:
    """An animal on four legs, or a bird on two: body, neck, head with muzzle and ears, tail."""
    length = log_uniform(rng, 0.03, 0.14)
    fat, leg, thick = rng.uniform(0.28, 0.5), rng.uniform(0.25, 0.8) * length, rng.uniform(0.06, 0.13) * length
    half = (0.5 * length, fat * 0.5 * length, fat * rng.uniform(0.5, 0.65) * length)
    z = leg + 0.6 * half[2]
    parts = [superquadric(half, rng.uniform(0.6, 1.0), rng.uniform(0.6, 1.0)).translate((0.0, 0.0, z))]
    two = rng.random() < 0.2
    for x in [0.0] if two else [-0.36, 0.36]:
        swing = rng.uniform(-0.12, 0.12) * length
        for side in (-1.0, 1.0):
            y = side * 0.6 * half[1]
            foot = (x * length + swing * side, y * 1.1, thick)
            parts.append(capsule((x * length, y, z - 0.2 * half[2]), foot, thick, thick * rng.uniform(0.8, 1.2)))
    head, neck = rng.uniform(0.16, 0.28) * length, rng.uniform(0.1, 0.75) * length
    nape = np.asarray([0.38 * length, 0.0, z + 0.3 * half[2]])
    pose = np.radians(rng.uniform(15.0, 80.0))
    skull = nape + (neck + 0.5 * head) * np.asarray([np.cos(pose), 0.0, np.sin(pose)])
    parts.append(capsule(nape, skull, 0.75 * half[1], 0.6 * head))
    parts.append(superquadric((head, 0.8 * head, 0.85 * head), 0.9, 0.9).translate(tuple(skull)))
    parts.append(
        capsule(skull, skull + head * rng.uniform(0.8, 1.6) * np.asarray([1.0, 0.0, -0.25]), 0.5 * head, 0.25 * head)
    )
    ear, splay = head * rng.uniform(0.3, 1.2), rng.uniform(0.4, 0.7)
    for side in (-1.0, 1.0):
        root = skull + head * np.asarray([-0.2, side * splay, 0.5])
        parts.append(capsule(root, root + ear * np.asarray([-0.2, side * 0.4, 0.9]), 0.22 * head, 0.14 * head))
    rump, tail = np.asarray([-0.42 * length, 0.0, z + 0.2 * half[2]]), rng.uniform(0.1, 0.7) * length
    lift = np.radians(rng.uniform(-60.0, 60.0))
    end = rump + tail * np.asarray([-np.cos(lift), 0.0, np.sin(lift)])
    end[2] = max(end[2], 0.06 * length)
    parts.append(capsule(rump, end, 0.07 * length, rng.uniform(0.03, 0.06) * length))
    return union(parts)


def figure(rng: np.random.Generator) -> Solid:
    """A figure of a person or robot: legs, trunk, arms in some pose, head, sometimes a hat and a base."""
    h = log_uniform(rng, 0.05, 0.3)
    wide, limb, square = rng.uniform(0.12, 0.22) * h, rng.uniform(0.035, 0.06) * h, rng.uniform(0.25, 1.0)
    hip, head = rng.uniform(0.3, 0.45) * h, rng.uniform(0.08, 0.15) * h
    neck = h - 2.0 * head
    parts = [
        superquadric((0.6 * wide, wide, 0.55 * (neck - hip)), square, square).translate((0.0, 0.0, 0.5 * (neck + hip)))
    ]
    parts.append(superquadric((head, head, 1.1 * head), square, square).translate((0.0, 0.0, neck + head)))
    for side in (-1.0, 1.0):
        stance = rng.uniform(-0.08, 0.08) * h
        parts.append(capsule((0.0, side * 0.5 * wide, hip), (stance, side * 0.6 * wide, limb), 1.2 * limb, limb))
        parts.append(capsule((stance, side * 0.6 * wide, limb), (stance + 1.5 * limb, side * 0.65 * wide, limb), limb))
        shoulder = np.asarray([0.0, side * 0.85 * wide, neck - 0.1 * (neck - hip)])
        lift, forward = np.radians(rng.uniform(-75.0, 80.0)), rng.uniform(-0.5, 0.9)
        elbow = shoulder + 0.16 * h * np.asarray([forward, side * np.cos(lift), np.sin(lift)])
        parts += [
            capsule(shoulder, elbow, limb),
            capsule(
                elbow,
                elbow + rng.uniform(0.1, 0.15) * h * np.asarray([0.8, 0.0, rng.uniform(-0.6, 0.8)]),
                limb,
                0.8 * limb,
            ),
        ]
    if rng.random() < 0.35:
        parts.append(Solid.cylinder(1.2 * head, 1.3 * head, 0.5 * head, 32).translate((0.0, 0.0, neck + 1.5 * head)))
    if rng.random() < 0.3:
        parts.append(Solid.cylinder(0.03 * h, 1.5 * wide, 1.4 * wide, 40).translate((0.0, 0.0, -0.01 * h)))
    return union(parts)


def vehicle(rng: np.random.Generator) -> Solid:
    """A toy car, van, truck or tractor: body, cabin, wheels."""
    length = log_uniform(rng, 0.045, 0.28)
    width, low = length * rng.uniform(0.35, 0.55), length * rng.uniform(0.12, 0.25)
    wheel, clear = length * rng.uniform(0.08, 0.15), length * rng.uniform(0.04, 0.09)
    cabin, height, place = (
        rng.uniform(0.3, 0.7) * length,
        length * rng.uniform(0.12, 0.3),
        rng.uniform(-0.25, 0.2) * length,
    )
    soft = rng.uniform(0.02, 0.25)
    parts = [rounded_box((length, width, low), soft * low).translate((0.0, 0.0, clear))]
    top = rounded_box((cabin, 0.92 * width, height + 0.2 * low), soft * height, taper=rng.uniform(0.6, 1.0))
    place = float(np.clip(place, -0.5 * (length - cabin), 0.5 * (length - cabin)))
    parts.append(top.translate((place, 0.0, clear + 0.8 * low)))
    tyre = rng.uniform(0.12, 0.25) * width
    axle = rng.uniform(0.28, 0.36) * length
    for x in (-axle, axle):
        for y in (-0.5, 0.5):
            tyre_ = Solid.cylinder(tyre, wheel, -1.0, 32, True).rotate((90.0, 0.0, 0.0))
            parts.append(tyre_.translate((x, y * width, wheel)))
    return union(parts)


def blocks(rng: np.random.Generator) -> Solid:
    """Two to six toy blocks glued into a stack or a building."""
    unit = log_uniform(rng, 0.012, 0.06)
    parts, z, x, y = [], 0.0, 0.0, 0.0
    for _ in range(int(rng.integers(2, 7))):
        size = unit * rng.uniform(0.6, 2.2, 3)
        height = float(size[2])
        style = rng.integers(4)
        if style == 0:
            part = Solid.cylinder(height, 0.5 * size[0], -1.0, 40)
        elif style == 1:
            part = rounded_box(size, 0.1 * unit, taper=rng.uniform(0.3, 1.0))
        else:
            part = rounded_box(size, rng.uniform(0.0, 0.1) * unit, chamfered=style == 2)
        parts.append(part.rotate((0.0, 0.0, rng.uniform(0.0, 90.0))).translate((x, y, z)))
        if rng.random() < 0.65:
            z += 0.98 * height
        else:
            x += rng.choice([-0.5, 0.5]) * float(size[0])
        x, y = x + rng.uniform(-0.15, 0.15) * unit, y + rng.uniform(-0.15, 0.15) * unit
    return union(parts)


def superquadric_toy(rng: np.random.Generator) -> Solid:
    """Two to seven superquadrics, each on the surface of an earlier one, turned at random."""
    size = log_uniform(rng, 0.012, 0.055)
    centres, parts = [np.zeros(3)], []
    reach: list[float] = []
    for i in range(int(rng.integers(2, 8))):
        half = size * rng.uniform(0.35, 1.6, 3)
        if i:
            direction, parent = rng.normal(size=3), int(rng.integers(i))
            step = 0.8 * reach[parent] + 0.5 * float(half.min())
            centres.append(centres[parent] + step * direction / np.linalg.norm(direction))
        reach.append(float(half.min()))
        part = superquadric(half, rng.uniform(0.2, 1.5), rng.uniform(0.2, 1.5), 32)
        parts.append(part.rotate(tuple(rng.uniform(0.0, 360.0, 3))).translate(tuple(centres[i])))
    return union(parts)


def controller(rng: np.random.Generator) -> Solid:
    """A game controller: a bar between two grips, sticks and buttons."""
    width = log_uniform(rng, 0.09, 0.18)
    depth, thick, spread = 0.3 * width, 0.09 * width, rng.uniform(0.25, 0.33) * width
    parts = [superquadric((0.5 * depth, 0.42 * width, thick), 0.6, 0.5)]
    for side in (-1.0, 1.0):
        start, length = np.asarray([0.05 * width, side * spread, 0.0]), rng.uniform(0.25, 0.42) * width
        end = start + length * np.asarray([-0.92, side * rng.uniform(0.1, 0.5), -0.2])
        parts.append(capsule(start, end, rng.uniform(0.1, 0.13) * width, rng.uniform(0.065, 0.09) * width))
        stick = Solid.cylinder(0.08 * width, 0.035 * width, 0.055 * width, 24)
        parts.append(stick.translate((rng.uniform(-0.06, 0.06) * width, side * 0.17 * width, 0.7 * thick)))
        button = Solid.cylinder(0.05 * width, 0.03 * width, -1.0, 24)
        parts.append(button.translate((0.06 * width, side * 0.32 * width, 0.08 * width)))
    return union(parts)


def shoe(rng: np.random.Generator) -> Solid:
    """A shoe, slipper or boot: a low toe, an open ankle, a sole."""
    length = log_uniform(rng, 0.09, 0.32)
    width, ankle = length * rng.uniform(0.3, 0.4), length * rng.uniform(0.3, 0.65)
    toe, curve = length * rng.uniform(0.15, 0.22), rng.uniform(-0.12, 0.12)
    wall = min(rng.uniform(0.002, 0.006), 0.12 * toe)
    throat, heel = rng.uniform(-0.05, 0.15), rng.uniform(0.72, 0.9)

    def last(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        s = p[:, 0] / length  # -0.5 at the heel, 0.5 at the toe
        rise = 0.5 - 0.5 * np.tanh((s - throat) / 0.12)
        height = toe + (ankle - toe) * rise
        girth = heel + (1.0 - heel) * (0.5 + 0.5 * np.tanh((s - 0.05) / 0.15))
        girth = girth * (1.0 - 0.25 * rise * np.clip(p[:, 2], 0.0, 1.0))
        return np.stack([p[:, 0], p[:, 1] * girth + curve * length * s * s, (p[:, 2] + 1.0) * 0.5 * height], axis=1)

    upper = superquadric((0.5 * length, 0.5 * width, 1.0), 0.45, 0.7, 64)
    inner = superquadric((0.5 * length - wall, 0.5 * width - wall / heel, 1.0 - 2.0 * wall / toe), 0.45, 0.7, 64)
    hollow = upper.warp_batch(last) - inner.warp_batch(last)
    cut, tilt = toe + rng.uniform(0.45, 0.75) * (ankle - toe), rng.uniform(0.0, 0.3)
    hollow = hollow.trim_by_plane((tilt, 0.0, -1.0), -(cut + 0.3 * tilt * length) / np.hypot(1.0, tilt))
    sole = plate(upper.warp_batch(last).project().offset(0.003), 0.05 * length)
    return hollow + sole


def turned_stand(rng: np.random.Generator) -> Solid:
    """A free lathe that is solid: a candlestick, chess piece, bell, cone, lampstand or spinning top."""
    h = log_uniform(rng, 0.03, 0.33)
    style = rng.choice(["free", "bell", "cone", "lamp"], p=[0.55, 0.15, 0.15, 0.15])
    if style == "bell":
        r = h * rng.uniform(0.3, 0.5)
        knots = [(r, 0.0), (0.75 * r, 0.2 * h), (0.6 * r, 0.55 * h), (0.35 * r, 0.7 * h), (0.3 * r, 0.75 * h)]
        bell = lathe(smooth([*knots, (0.28 * r, 0.8 * h)], 30))
        cavity = lathe(
            smooth([(0.93 * r, -0.001), (0.66 * r, 0.19 * h), (0.5 * r, 0.53 * h), (0.05 * r, 0.66 * h)], 24)
        )
        return union([bell - cavity, knob(rng, 0.79 * h, 0.07 * h)])
    if style == "cone":
        r, tip = h * rng.uniform(0.2, 0.5), rng.uniform(0.02, 0.5)
        cone = lathe(np.asarray([(r, 0.03 * h), (tip * r, h)]), section_warp(rng, 0.5))
        return cone + rounded_box((2.2 * r, 2.2 * r, 0.04 * h), 0.01 * h) if rng.random() < 0.4 else cone
    if style == "lamp":
        r, thin, shade = h * rng.uniform(0.15, 0.28), h * rng.uniform(0.02, 0.05), h * rng.uniform(0.18, 0.35)
        knots = [(r, 0.0), (r, 0.03 * h), (thin, 0.08 * h), (thin, 0.62 * h), (0.5 * shade, 0.62 * h)]
        return lathe(np.asarray([*knots, (shade, 0.6 * h), (rng.uniform(0.4, 0.9) * shade, h)]))
    count = int(rng.integers(5, 10))
    wide = h * rng.uniform(0.15, 0.4)
    radii = wide * rng.uniform(0.15, 1.0, count)
    radii[0] = wide * rng.uniform(0.7, 1.1)
    heights = h * (
        0.7 * np.linspace(0.0, 1.0, count) + 0.3 * np.sort(np.concatenate([[0.0, 1.0], rng.random(count - 2)]))
    )
    return lathe(smooth(list(zip(radii, heights, strict=True)), 56), section_warp(rng, 0.75))


def pouch(rng: np.random.Generator) -> Solid:
    """A bag of food, a pillow or a tube of cream: full in the middle, flat and welded at one end or both."""
    length = log_uniform(rng, 0.06, 0.3)
    width, full, both = length * rng.uniform(0.45, 0.9), length * rng.uniform(0.1, 0.3), rng.random() < 0.6
    thin, step = max(0.0015, 0.012 * length), length / 28.0

    def press(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        s = 2.0 * p[:, 0] / length
        inside = np.clip(1.0 - np.abs(s) ** 2.5 if both else 1.0 - np.clip(0.5 * s + 0.5, 0.0, 1.0) ** 2, 0.0, 1.0)
        side = np.sqrt(np.clip(1.0 - (2.0 * p[:, 1] / width) ** 2, 0.0, 1.0))
        return np.stack(
            [p[:, 0], p[:, 1] * (1.0 - 0.12 * inside), p[:, 2] / step * (thin + full * inside * side)], axis=1
        )

    slab = rounded_box((length, width, step)).translate((0.0, 0.0, -0.5 * step))
    return lumpy(slab.refine_to_length(step).warp_batch(press), rng, 0.015)


def arch(rng: np.random.Generator) -> Solid:
    """Headphones or a toy bridge: an arch between two ends."""
    size = log_uniform(rng, 0.06, 0.2)
    half = size * rng.uniform(0.02, 0.05)
    bow = arc((0.0, 0.0), (0.5 * size, size * rng.uniform(0.45, 0.7)), 0.0, 180.0, 32)
    cup = rng.uniform(0.15, 0.24) * size
    pads = [rod(cup, -0.3 * cup, 0.3 * cup).translate((s * 0.47 * size, 0.0, 0.0)) for s in (-1.0, 1.0)]
    return union([tube(bow, half, half * rng.uniform(1.0, 3.0), 3.0), *pads])
