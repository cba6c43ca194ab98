"""Household tools, cutlery and small equipment: thin and long things, lying.

Each function draws one from a generator: metres, its long axis is x.
"""

import numpy as np

from probnerf.objects.household_parts import (
    Section,
    Solid,
    arc,
    bent,
    capsule,
    disc,
    lathe,
    log_uniform,
    plate,
    rectangle,
    rod,
    rounded_box,
    smooth,
    stroke,
    superquadric,
    tube,
    union,
)


def _grip(rng: np.random.Generator, start: float, end: float, radius: float) -> Solid:
    """A tool's handle along x: bulged, waisted, stepped or flat."""
    length = end - start
    knots = [(radius * rng.uniform(0.6, 1.0), 0.0)]
    knots += [(radius * rng.uniform(0.65, 1.0), s * length) for s in (0.12, 0.35, 0.6, 0.85)]
    knots += [(radius * rng.uniform(0.5, 0.8), length)]
    solid = lathe(smooth(knots, 30)).rotate((0.0, 90.0, 0.0)).translate((start, 0.0, 0.0))
    return solid.scale((1.0, 1.0, rng.uniform(0.55, 1.0)))


def hammer(rng: np.random.Generator) -> Solid:
    """A hammer, mallet or axe-like head on a handle."""
    length = log_uniform(rng, 0.12, 0.34)
    radius, head = length * rng.uniform(0.035, 0.06), length * rng.uniform(0.28, 0.45)
    size = length * rng.uniform(0.04, 0.075)
    style = rng.choice(["claw", "mallet", "peen"])
    parts = [_grip(rng, 0.0, 0.98 * length, radius)]
    if style == "mallet":
        body = (
            rod(1.8 * size, -0.5 * head, 0.5 * head)
            if rng.random() < 0.5
            else rounded_box((head, 3 * size, 3 * size), 0.2 * size).translate((0, 0, -1.5 * size))
        )
    else:
        body = union([rod(size, -0.15 * head, 0.42 * head), rod(1.2 * size, 0.36 * head, 0.5 * head)])
        body += rounded_box((0.3 * head, 2.1 * size, 2.1 * size), 0.2 * size).translate((0.0, 0.0, -1.05 * size))
        if style == "peen":
            body += Solid.hull(
                rounded_box((0.02, 1.8 * size, 1.8 * size)).translate((0, 0, -0.9 * size))
                + rounded_box((0.004, 1.8 * size, 0.3 * size)).translate((-0.5 * head, 0.0, -0.15 * size))
            )
        else:
            prongs = [
                plate(
                    stroke(
                        np.asarray([(0.0, 0.2 * s * size), (-0.55 * head, 0.85 * s * size)]),
                        np.asarray([0.5 * size, 0.25 * size]),
                    ),
                    0.5 * size,
                )
                for s in (-1.0, 1.0)
            ]
            body += bent(union(prongs), rng.uniform(-1.2, -0.3) / head, 0.006)
    # The head crosses the handle in the plane of the table.
    turned = body.rotate((90.0, 0.0, 0.0)).rotate((0.0, 0.0, 90.0))
    return union([*parts, turned.translate((0.97 * length, 0.0, 0.0))])


def screwdriver(rng: np.random.Generator) -> Solid:
    """A screwdriver, awl, file or chisel: a grip and a shaft."""
    length = log_uniform(rng, 0.08, 0.3)
    grip, radius = rng.uniform(0.35, 0.55) * length, length * rng.uniform(0.045, 0.08)
    shaft = max(0.0015, radius * rng.uniform(0.18, 0.4))
    parts = [_grip(rng, 0.0, grip, radius), rod(shaft, 0.8 * grip, 0.96 * length)]
    tip = rng.integers(3)
    if tip == 0:
        parts.append(rod(shaft, 0.94 * length, length, 0.3 * shaft))
    elif tip == 1:
        parts.append(
            rounded_box((0.12 * length, 3.2 * shaft, shaft), 0.0).translate((0.94 * length, 0.0, -0.5 * shaft))
        )
    else:
        parts.append(
            rounded_box((length - grip, 5.0 * shaft, 1.2 * shaft), 0.0).translate(
                (0.5 * (length + grip), 0, -0.6 * shaft)
            )
        )
    return union(parts)


def wrench(rng: np.random.Generator) -> Solid:
    """An open, ring or combination wrench."""
    length = log_uniform(rng, 0.09, 0.3)
    head, shaft = length * rng.uniform(0.07, 0.12), length * rng.uniform(0.03, 0.05)
    section = stroke(np.asarray([(0.0, 0.0), (0.5 * length, 0.0), (length, 0.0)]), np.asarray([1.2, 0.9, 1.2]) * shaft)
    for place, side in ((0.0, 180.0), (length, 0.0)):
        style, size = rng.integers(2 if place == 0.0 else 3), head * rng.uniform(0.8, 1.1)
        tilt = side + rng.uniform(-25.0, 25.0)
        if style == 2:
            section += disc(0.6 * size, (place, 0.0))
            continue
        section += disc(size, (place, 0.0))
        if style == 0:
            jaw = rectangle((-0.1 * size, -0.5 * size), (2.0 * size, 0.5 * size)).rotate(tilt).translate((place, 0.0))
        else:
            jaw = disc(0.6 * size, (place, 0.0))
        section -= jaw
    return plate(section, length * rng.uniform(0.025, 0.05))


def _pair(rng: np.random.Generator, jaw: Section, grip: Section, thickness: float, pivot: float) -> Solid:
    """Two mirrored halves that cross at a pivot in the origin, one above the other, opened by an angle."""
    angle = rng.uniform(3.0, 28.0)
    half = plate(jaw + grip, thickness)
    lower, upper = half.rotate((0.0, 0.0, angle)), half.mirror((0.0, 1.0, 0.0)).rotate((0.0, 0.0, -angle))
    pin = Solid.cylinder(2.4 * thickness, pivot, -1.0, 32, True).translate((0.0, 0.0, 0.45 * thickness))
    return union([lower, upper.translate((0.0, 0.0, 0.9 * thickness)), pin])


def pliers(rng: np.random.Generator) -> Solid:
    """Pliers, tongs or nippers: two bent halves about a pivot."""
    length = log_uniform(rng, 0.1, 0.26)
    nose, width = rng.uniform(0.2, 0.4) * length, length * rng.uniform(0.03, 0.05)
    tip = width * rng.uniform(0.25, 0.9)
    jaw = stroke(
        np.asarray([(0.0, 0.0), (0.3 * nose, 0.5 * width), (nose, 0.3 * width)]),
        np.asarray([1.5 * width, 1.2 * width, tip]),
    )
    back = smooth([(0.0, 0.0), (-0.25 * length, -0.8 * width), (nose - length, -rng.uniform(0.0, 1.2) * width)], 10)
    return _pair(rng, jaw, stroke(back, width * rng.uniform(0.6, 0.9)), rng.uniform(0.006, 0.012), 1.3 * width)


def scissors(rng: np.random.Generator) -> Solid:
    """Scissors: two blades and two rings for fingers."""
    length = log_uniform(rng, 0.09, 0.24)
    blade, width, ring = rng.uniform(0.4, 0.62) * length, 0.055 * length, rng.uniform(0.09, 0.14) * length
    jaw = stroke(
        np.asarray([(-0.06 * length, 0.0), (0.0, 0.0), (blade, -0.15 * width)]), np.asarray([1.0, 1.0, 0.12]) * width
    )
    loop = arc((blade - length + ring, -ring - 0.3 * width), (1.3 * ring, ring), 0.0, 360.0, 28)
    neck = np.asarray([(-0.05 * length, 0.0), (float(loop[3, 0]), float(loop[3, 1]))])
    grip = stroke(loop, 0.022 * length + 0.001) + stroke(neck, 0.6 * width)
    return _pair(rng, jaw, grip, rng.uniform(0.0025, 0.006), 0.7 * width)


def brush(rng: np.random.Generator) -> Solid:
    """A toothbrush, dish brush, paint brush or hair brush."""
    length = log_uniform(rng, 0.11, 0.32)
    width, head = length * rng.uniform(0.03, 0.12), length * rng.uniform(0.18, 0.4)
    thick = max(0.004, 0.25 * width)
    grip = _grip(rng, 0.0, length - 0.9 * head, max(0.5 * thick, 0.03 * length))
    if rng.random() < 0.35:  # a paint brush: bristles along x
        ferrule = rounded_box((0.35 * head, 1.6 * width, thick), 0.15 * thick).translate(
            (length - head, 0.0, -thick / 2)
        )
        hair = rounded_box((0.7 * head, 1.5 * width, 0.85 * thick), 0.3 * thick).translate(
            (length - 0.6 * head, 0.0, -0.42 * thick)
        )
        return union([grip, ferrule, hair])
    plank = superquadric((0.52 * head, max(0.55 * width, 0.005), 0.5 * thick + 0.001), 0.4, 0.5).translate(
        (length - 0.45 * head, 0, 0)
    )
    height = rng.uniform(0.01, 0.025)
    hair = rounded_box((0.85 * head, max(0.9 * width, 0.007), height), 0.001, taper=rng.uniform(0.9, 1.2))
    return union([grip, plank, hair.translate((length - 0.45 * head, 0.0, 0.0))])


def torch(rng: np.random.Generator) -> Solid:
    """A torch, microphone or shaver: cylinders of several radii along x, with a switch."""
    length = log_uniform(rng, 0.08, 0.3)
    radius = length * rng.uniform(0.06, 0.11)
    body, head = rng.uniform(0.55, 0.8) * radius, rng.uniform(0.6, 0.75) * length
    knots = [(0.85 * body, 0.0), (body, 0.03 * length), (body, head), (radius, head + 0.08 * length), (radius, length)]
    parts = [lathe(np.asarray(knots)).rotate((0.0, 90.0, 0.0))]
    if rng.random() < 0.25:
        parts.append(Solid.sphere(1.15 * radius, 40).translate((length, 0.0, 0.0)))
    switch = superquadric((0.07 * length, 0.35 * body, 0.3 * body), 0.4, 0.5)
    parts.append(switch.translate((rng.uniform(0.4, 0.55) * length, 0.0, body)))
    return union(parts)


def cutlery(rng: np.random.Generator) -> Solid:
    """A knife, fork, spoon, ladle or spatula: thin, with a slightly bent handle."""
    length = log_uniform(rng, 0.1, 0.32)
    style = rng.choice(["knife", "fork", "spoon", "ladle", "spatula"])
    head, width, thick = rng.uniform(0.24, 0.4) * length, length * rng.uniform(0.05, 0.075), rng.uniform(0.0018, 0.0035)
    neck = length - head
    handle = stroke(
        smooth([(0.0, 0.0), (0.4 * length, 0.0), (neck + 0.1 * head, 0.0)], 10), np.linspace(0.032, 0.014, 10) * length
    )
    if style == "knife":
        blade = np.asarray(
            [
                (neck - 0.02, -0.2 * width),
                (neck, -0.5 * width),
                (length - 0.3 * head, -0.5 * width),
                (length, 0.25 * width),
                (length - 0.2 * head, 0.45 * width),
                (neck - 0.02, 0.4 * width),
            ]
        )
        grip = _grip(rng, 0.0, neck, rng.uniform(0.028, 0.045) * length)
        return union([grip, plate(Section([blade]), thick)])
    if style == "fork":
        tines, gap = int(rng.integers(3, 5)), 0.45 * width / 3.0
        palm = rectangle((neck, -0.5 * width), (length, 0.5 * width), 0.25 * width)
        for i in range(1, tines):
            y = width * (i / tines - 0.5)
            palm -= rectangle((neck + 0.45 * head, y - 0.5 * gap), (length + 0.01, y + 0.5 * gap))
        return bent(
            plate(handle + palm, thick).translate((-0.7 * length, 0.0, 0.0)), rng.uniform(0.3, 1.2) / length, 0.008
        )
    if style == "spatula":
        palm = rectangle((neck, -1.2 * width), (length, 1.2 * width), 0.3 * width)
        for y in (-0.6, 0.0, 0.6):
            palm -= rectangle(
                (neck + 0.25 * head, (y - 0.14) * width), (length - 0.2 * head, (y + 0.14) * width), 0.001
            )
        return bent(plate(handle + palm, thick).translate((-neck, 0.0, 0.0)), rng.uniform(-1.0, 1.0) / length, 0.008)
    deep = rng.uniform(0.3, 0.6) * width if style == "spoon" else rng.uniform(0.9, 1.5) * width
    deep = max(deep, 2.0 * thick)
    half = (0.5 * head, 0.62 * width) if style == "spoon" else (1.3 * width, 1.3 * width)
    shell = superquadric((*half, deep), 1.0, 1.0, 48) - superquadric(
        (half[0] - thick, half[1] - thick, deep - thick), 1.0, 1.0, 48
    )
    shell = shell.trim_by_plane((0.0, 0.0, -1.0), 0.0).translate((length - half[0], 0.0, 0.0))
    bar = plate(
        stroke(
            np.asarray([(0.0, 0.0), (length - 2.0 * half[0] + 0.9 * thick, 0.0)]), np.asarray([0.032, 0.016]) * length
        ),
        thick,
    )
    bar = bent(bar.translate((-length + 2.0 * half[0], 0.0, -0.5 * thick)), rng.uniform(0.0, 1.5) / length, 0.008)
    return union([shell, bar.translate((length - 2.0 * half[0], 0.0, 0.0))])


def dumbbell(rng: np.random.Generator) -> Solid:
    """A dumbbell, rolling pin or spool: a bar between two ends."""
    length = log_uniform(rng, 0.06, 0.34)
    end, bar, share = length * rng.uniform(0.12, 0.24), length * rng.uniform(0.04, 0.08), rng.uniform(0.1, 0.3)
    style = rng.integers(3)
    if style == 0:
        ends = [Solid.sphere(end, 40).translate((s * (0.5 * length - end), 0.0, 0.0)) for s in (-1.0, 1.0)]
    else:
        sides = 48 if style == 1 else 6
        weight = rod(end, -0.5 * share * length, 0.5 * share * length, None, sides)
        ends = [weight.translate((0.5 * s * (1.0 - share) * length, 0.0, 0.0)) for s in (-1.0, 1.0)]
    return union([rod(bar, -0.45 * length, 0.45 * length), *ends])


def ring(rng: np.random.Generator) -> Solid:
    """A roll of tape, a bracelet or doughnut, or a key, lying."""
    style = rng.integers(3)
    outer = log_uniform(rng, *((0.016, 0.09), (0.02, 0.06), (0.01, 0.02))[style])
    inner = outer * rng.uniform(0.4, 0.9)
    if style == 0:
        return plate(disc(outer) - disc(inner), outer * rng.uniform(0.15, 1.2))
    half = 0.5 * (outer - inner)
    torus = disc(half, (outer - half, 0.0)).revolve(56)
    if style == 1:
        return torus.scale((1.0, rng.uniform(0.7, 1.0), rng.uniform(0.8, 1.6)))
    bit = capsule((outer - half, 0.0, 0.0), (2.2 * outer, 0.0, 0.0), 0.8 * half)
    teeth = [
        rounded_box((0.15 * outer, 0.45 * outer, 0.9 * half)).translate(
            (2.2 * outer - 0.3 * i * outer, 0.25 * outer, -0.45 * half)
        )
        for i in range(int(rng.integers(1, 3)))
    ]
    return union([torus, bit, *teeth])  # a key


def hook(rng: np.random.Generator) -> Solid:
    """A hook, hanger, handle or clamp: a bent bar like a J, S, U or C."""
    size = log_uniform(rng, 0.03, 0.2)
    half, style = size * rng.uniform(0.05, 0.12), rng.choice(["j", "s", "u", "c"])
    r = 0.28 * size
    if style == "j":
        path = np.concatenate([[(r, 0.6 * size)], arc((0.0, 0.0), (r, r), 0.0, -rng.uniform(150.0, 230.0), 24)])
    elif style == "s":
        path = np.concatenate([arc((0.0, r), (r, r), 0.0, 270.0, 24), arc((0.0, -r), (r, r), 90.0, -180.0, 24)[1:]])
    elif style == "u":
        path = np.concatenate([[(r, 0.7 * size)], arc((0.0, 0.0), (r, r), 0.0, -180.0, 24), [(-r, 0.7 * size)]])
    else:
        path = arc((0.0, 0.0), (0.5 * size, 0.4 * size), 35.0, 325.0, 30)
    if style != "c":
        return plate(stroke(path, half), 2.0 * half * rng.uniform(0.6, 2.5))
    frame = plate(stroke(path, 1.2 * half), 1.6 * half)
    x, y = path[0]
    screw = Solid.cylinder(0.55 * size, 0.45 * half, -1.0, 24, True).rotate((90.0, 0.0, 0.0)).translate((x, y, 0.0))
    bar = rod(0.35 * half, x - 1.8 * half, x + 1.8 * half).translate((0.0, y + 0.27 * size, 0.0))
    return union([frame, screw, bar])


def handheld(rng: np.random.Generator) -> Solid:
    """A remote control, phone, calculator or computer mouse: a slab with keys or a lens."""
    length = log_uniform(rng, 0.06, 0.24)
    width, thick = length * rng.uniform(0.25, 0.65), length * rng.uniform(0.05, 0.16)
    if rng.random() < 0.25:
        shell = superquadric((0.5 * length, 0.5 * width, thick * 1.5), 0.8, rng.uniform(0.5, 0.9))
        return shell.trim_by_plane((0.0, 0.0, 1.0), -0.3 * thick)
    body = rounded_box((length, width, thick), rng.uniform(0.1, 0.45) * thick)
    columns, rows = int(rng.integers(0, 5)), int(rng.integers(2, 7))
    key = rounded_box((0.45 * length / rows, 0.55 * width / max(columns, 1), 0.3 * thick), 0.03 * thick)
    keys = [
        key.translate(((0.7 * i / rows - 0.4) * length, ((j + 0.5) / columns - 0.5) * 0.85 * width, 0.85 * thick))
        for i in range(rows)
        for j in range(columns)
    ]
    return union([body, *keys])


def spectacles(rng: np.random.Generator) -> Solid:
    """Spectacles, standing on the edges of the rims and folded out; true lenses are left out."""
    width = log_uniform(rng, 0.11, 0.15)
    half, rim = 0.002 + rng.uniform(0.0, 0.0015), width * rng.uniform(0.19, 0.23)
    loop = arc((0.0, 0.0), (rim, rim * rng.uniform(0.6, 0.95)), 0.0, 360.0, 32)
    place = 0.5 * width - rim
    lens = stroke(loop, half)
    front = lens.translate((place, 0.0)) + lens.translate((-place, 0.0))
    front += stroke(np.asarray([(rim - place, 0.2 * rim), (place - rim, 0.2 * rim)]), half)
    side = smooth([(0.0, 0.3 * rim), (-0.75 * width, 0.3 * rim), (-0.95 * width, -0.4 * rim)], 16)
    arms = [tube(side, half, half).translate((0.0, s * (place + 0.97 * rim), 0.0)) for s in (-1.0, 1.0)]
    return union([plate(front, 2.0 * half, upright=True).rotate((0.0, 0.0, 90.0)), *arms])
