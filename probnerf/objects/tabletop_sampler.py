"""Random shapes and appearances of tabletop objects, as plain arrays: the fields of `tabletop.TabletopObject`.

Lengths are canonical cube units, angles radians; s in [0, 1] is the height as a fraction of the body's.
"""

import colorsys

import numpy as np

from probnerf.types import BASE_Z, BODY_EXTENT

KINDS = ("can", "cup", "mug", "bowl", "bottle", "pitcher", "carton")
CAN, CUP, MUG, BOWL, BOTTLE, PITCHER, CARTON = range(7)
TEXTURES = ("plain", "banded", "labelled", "printed")
PLAIN, BANDED, LABELLED, PRINTED = range(4)

REACH_LIMIT = 0.95  # limit of every part's |x| before slack, so that it stays in the cube after it
SLACK_LOG_SCALE = 0.05  # standard deviations of the placement in the cube
SLACK_SHIFT = 0.03

_KIND_WEIGHTS = (0.14, 0.12, 0.24, 0.10, 0.12, 0.14, 0.14)
_TEXTURE_WEIGHTS = (0.35, 0.20, 0.25, 0.20)
OUTER_VERTICES, _INNER, _TUBE = 10, 5, 9  # vertices of the outer and inner profile, and of the handle's centre line
ABSENT = -8.0  # radius of an absent part: its distance is then at least 8


def _profile(rng: np.random.Generator, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights u in [0, 1] and radii (largest 1) of the outer profile, chamfered at both ends by the caller."""
    u = np.linspace(0.0, 1.0, OUTER_VERTICES - 2)
    if kind == CAN:
        radius = np.ones_like(u)
    elif kind == BOWL:
        u = u**1.5  # the curvature sits near the base
        foot = rng.uniform(0.3, 0.6)
        radius = foot + (1.0 - foot) * u ** rng.uniform(0.4, 0.8)
    elif kind == BOTTLE:
        shoulder = rng.uniform(0.45, 0.75)
        neck = shoulder + rng.uniform(0.08, 0.22)
        u = np.concatenate([[0.0, 0.5 * shoulder], np.linspace(shoulder, neck, 5), [1.0]])
        blend = np.clip((u - shoulder) / (neck - shoulder), 0.0, 1.0)
        blend = blend * blend * (3.0 - 2.0 * blend)
        radius = 1.0 + blend * (rng.uniform(0.25, 0.55) - 1.0)
        radius[:2] *= 1.0 - rng.uniform(0.0, 0.12) * np.array([1.0, 0.3])
    else:
        style = rng.uniform()
        if kind == CUP:
            low = rng.uniform(0.6, 0.95)
            radius = low + (1.0 - low) * u
        elif kind == MUG and style < 0.5:
            radius = np.ones_like(u)
        elif kind == MUG and style < 0.75:
            low = rng.uniform(0.75, 1.15)
            radius = low + (1.0 - low) * u
        elif kind == MUG:
            radius = 1.0 - rng.uniform(-0.1, 0.2) * (2.0 * u - 1.0) ** 2
        elif style < 0.65:  # tapered pitcher
            low = rng.uniform(0.85, 1.3)
            radius = low + (1.0 - low) * u
        else:  # belly
            radius = rng.uniform(0.55, 0.8) + 0.4 * np.sin(np.pi * np.clip(u, 0, 1) ** rng.uniform(0.6, 1.0)) ** 1.3
        radius = radius + rng.uniform(0.0, 0.025) * np.sin(2 * np.pi * (rng.uniform(0.5, 1.2) * u + rng.uniform()))
    return u, radius / radius.max()


def _aspect(rng: np.random.Generator, kind: int) -> float:
    """Body diameter over height."""
    if kind == CAN and rng.uniform() < 0.2:
        return rng.uniform(1.1, 2.6)
    low, high = {CAN: (0.5, 1.1), CUP: (0.6, 1.0), MUG: (0.7, 1.2), BOWL: (1.6, 3.0), BOTTLE: (0.28, 0.5)}.get(
        kind, (0.42, 0.85)
    )
    return rng.uniform(low, high)


def _largest_side_m(rng: np.random.Generator, kind: int) -> float:
    low, high = (
        (0.05, 0.18),
        (0.06, 0.15),
        (0.07, 0.14),
        (0.09, 0.26),
        (0.10, 0.30),
        (0.13, 0.30),
        (0.05, 0.28),
    )[kind]
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _handle(
    rng: np.random.Generator, kind: int, z: np.ndarray, radius: np.ndarray, wall: float
) -> tuple[np.ndarray, float, float]:
    """Centre line (x, z), tube radius and extra half width across y of a handle on the profile radius(z)."""
    height = z[-1] - z[0]
    tube = rng.uniform(0.045, 0.1)
    across = max(rng.uniform(0.05, 0.13) - tube, 0.0)
    top = z[-1] - height * rng.uniform(0.05, 0.25) - tube
    bottom = min(z[0] + height * rng.uniform(0.08, 0.45 if kind == MUG else 0.5) + tube, top - 0.4)
    bottom = max(bottom, z[0] + tube + 0.02)
    ends = np.interp([bottom, top], z, radius)
    reach = max(rng.uniform(0.22, 0.5), 2.0 * tube + 0.12)
    reach = max(min(reach, REACH_LIMIT - ends.max()), 2.0 * tube + 0.1)  # outward extent, tube included
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _TUBE)
    cosine, sine = np.maximum(np.cos(angle), 0.0), np.sin(angle)
    squareness = rng.uniform(0.45, 1.0)  # 1: a half ellipse; small: a D
    skew, bulge = rng.uniform(-0.15, 0.35), rng.uniform(0.0, 0.35) * (rng.uniform() < 0.4)
    half = 0.5 * (top - bottom)
    line_z = 0.5 * (top + bottom) + half * np.sign(sine) * np.abs(sine) ** squareness * (1.0 + bulge * cosine)
    out = cosine**squareness * (1.0 + skew * sine)
    line_z = np.clip(line_z, z[0] + tube + 0.01, z[-1] + 0.12)
    along = np.linspace(0.0, 1.0, _TUBE)
    wall_x = np.maximum((1 - along) * ends[0] + along * ends[1], np.interp(line_z, z, radius))
    # The balls at the ends reach the wall, but not the cavity.
    line_x = wall_x + max(tube - wall, 0.0) + 0.01 + (reach - tube) * out / out.max()
    line_x = np.minimum(line_x, REACH_LIMIT - tube)
    return np.stack([line_x, line_z], axis=-1), tube, across


def random_colour(rng: np.random.Generator) -> np.ndarray:
    """A paint's colour in [0, 1]: white, dark or of any hue."""
    style = rng.uniform()
    if style < 0.2:
        return rng.uniform(0.82, 1.0) * rng.uniform(0.94, 1.0, 3)
    if style < 0.3:
        return rng.uniform(0.05, 0.3) * rng.uniform(0.9, 1.0, 3)
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.2, 0.95), rng.uniform(0.35, 1.0)))


def random_light(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vector towards a lamp, ambient light and the lamp's, each rgb."""
    light = np.array([*rng.normal(size=2), rng.uniform(0.3, 2.0)])
    ambient, lamp = rng.uniform(0.35, 0.75), rng.uniform(0.2, 0.65)
    return light / np.linalg.norm(light), ambient * rng.uniform(0.95, 1.05, 3), lamp * rng.uniform(0.92, 1.08, 3)


def _appearance(rng: np.random.Generator, kind: int, is_closed: bool) -> dict[str, np.ndarray | float]:
    """Paint, pattern and light."""
    texture = rng.choice(len(TEXTURES), p=_TEXTURE_WEIGHTS)
    paint = np.stack([random_colour(rng) for _ in range(7)])
    if rng.uniform() < 0.6 or texture == PRINTED:
        paint[5] = paint[0]
    if rng.uniform() < 0.5:
        paint[6] = paint[0]
    waves = rng.normal(size=(2, 3, 4))
    waves[..., :3] *= (rng.uniform(4.0, 11.0) / np.linalg.norm(waves[..., :3], axis=-1))[..., None]
    waves[..., 3] = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    lid_start = 2.0
    if is_closed and kind in (CAN, BOTTLE, MUG, PITCHER) and rng.uniform() < 0.75:
        lid_start = {CAN: rng.uniform(0.9, 0.995), BOTTLE: rng.uniform(0.82, 0.95)}.get(kind, rng.uniform(0.88, 0.97))
    wraps = rng.uniform() < (0.5 if kind in (CAN, BOTTLE) else 0.15)
    light = np.array([*rng.normal(size=2), rng.uniform(0.3, 2.0)])
    ambient, lamp = rng.uniform(0.35, 0.75), rng.uniform(0.2, 0.65)
    low = rng.uniform(0.05, 0.4)
    return {
        "texture": texture,
        "paint": paint,
        "bands": np.array([rng.uniform(0.7, 4.0), rng.uniform(), rng.uniform(-0.6, 0.6)]),
        "label": np.array(
            [
                rng.uniform(-np.pi, np.pi),
                -1.01 if wraps else np.cos(rng.uniform(0.4, 1.6)),
                rng.uniform(0.5, 0.95),
                low,
                min(low + rng.uniform(0.3, 0.6), 0.95),
            ]
        ),
        "waves": waves,
        "pattern_level": rng.uniform(-0.2, 0.9, 2),
        "lid_start": lid_start,
        "light": light / np.linalg.norm(light),
        "ambient": ambient * rng.uniform(0.95, 1.05, 3),
        "lamp": lamp * rng.uniform(0.92, 1.08, 3),
    }


def _vessel(rng: np.random.Generator, kind: int) -> dict[str, np.ndarray | float]:
    aspect = _aspect(rng, kind)
    height = min(BODY_EXTENT, BODY_EXTENT / aspect)
    u, radius = _profile(rng, kind)
    radius = 0.5 * aspect * height * radius
    z = BASE_Z + height * u
    is_closed = kind in (CAN, BOTTLE) or rng.uniform() < {MUG: 0.08, PITCHER: 0.45}.get(kind, 0.0)
    wall = rng.uniform(0.07, 0.13)
    chamfer = rng.uniform(0.008, 0.03)
    # Chamfers keep the largest radius and both end planes; the vertices next to the ends move along the profile.
    outer_z = np.concatenate([[z[0], z[0] + chamfer], z[1:-1], [z[-1] - chamfer, z[-1]]])
    outer_r = np.interp(outer_z, z, radius)
    outer_r[[0, -1]] -= chamfer
    outer_r *= radius.max() / outer_r.max()  # a chamfer may have reduced the largest radius
    outline = np.tile([0.0, z[-1]], (17, 1))
    outline[0] = 0.0, z[0]
    outline[1 : 1 + OUTER_VERTICES] = np.stack([outer_r, outer_z], axis=-1)
    if not is_closed:
        floor = z[0] + rng.uniform(0.07, 0.13)
        inner_z = floor + (z[-1] - floor) * (np.linspace(1.0, 0.0, _INNER) ** (1.5 if kind == BOWL else 1.0))
        inner_r = np.maximum(np.interp(inner_z, z, radius) - wall, 0.05)
        inner_r[0] += min(chamfer, 0.3 * wall)
        outline[11 : 11 + _INNER] = np.stack([inner_r, inner_z], axis=-1)
        outline[16] = 0.0, floor
    shape: dict[str, np.ndarray | float] = {
        "is_open": not is_closed,
        "outline": outline,
        "box": np.array([0.3, 0.3, 0.3, 0.01]),
        "body_reach": np.array([radius.max(), radius.max()]),
        "top": z[-1],
    }
    thickness = 0.13 if is_closed else wall
    if kind in (MUG, PITCHER) and rng.uniform() < 0.85:
        tube, tube_radius, across = _handle(rng, kind, z, radius, thickness)
        shape |= {"tube": tube, "tube_section": np.array([tube_radius, across])}
    if kind == PITCHER and rng.uniform() < 0.7:
        thick, thin = rng.uniform(0.1, 0.16), rng.uniform(0.05, 0.08)
        foot = z[-1] - thick - height * rng.uniform(0.0, 0.12)
        x = np.interp(foot, z, radius) + max(thick - thickness, 0.0) + 0.01
        tip_x = x + rng.uniform(0.1, 0.22)
        tip_z = min(foot + rng.uniform(0.08, 0.25), z[-1] + 0.05)
        shape["spout"] = np.array([[-x, foot, thick], [-tip_x, tip_z, thin]])
    return shape


def _carton(rng: np.random.Generator) -> dict[str, np.ndarray | float]:
    """A box whose front is its widest upright face; upright, or lying on its largest face."""
    sides = np.sort(np.array([rng.uniform(0.2, 0.75), rng.uniform(0.4, 1.0), 1.0]))
    lying = rng.uniform() < 0.3
    depth, width, height = (sides[1], sides[2], sides[0]) if lying else (sides[0], sides[1], sides[2])
    if not lying and rng.uniform() < 0.25:
        width, height = height, width  # it stands on its long narrow side
    half = 0.5 * BODY_EXTENT * np.array([depth, width, height])
    rounding = min(rng.uniform(0.005, 0.06), 0.4 * half.min())
    return {
        "is_open": False,
        "outline": np.tile([0.0, BASE_Z], (17, 1)),
        "box": np.array([*half, rounding]),
        "body_reach": half[:2],
        "top": BASE_Z + 2.0 * half[2],
    }


def draw(seed: int, slack: float) -> dict[str, np.ndarray | float]:
    """Every field of the object of a seed; `slack` multiplies the standard deviations of its placement."""
    rng = np.random.default_rng([seed, 7])
    kind = int(rng.choice(len(KINDS), p=_KIND_WEIGHTS))
    shape = _carton(rng) if kind == CARTON else _vessel(rng, kind)
    has_handle = "tube" in shape
    absent_line = np.stack([np.linspace(0.0, 0.1, _TUBE), np.zeros(_TUBE)], axis=-1)
    reach, top = np.asarray(shape.pop("body_reach")), shape.pop("top")
    lower, upper = np.array([*-reach, BASE_Z]), np.array([*reach, top])
    if has_handle:
        tube, (radius, across) = np.asarray(shape["tube"]), np.asarray(shape["tube_section"])
        upper = np.maximum(upper, [tube[:, 0].max() + radius, radius + across, tube[:, 1].max() + radius])
    if "spout" in shape:
        spout = np.asarray(shape["spout"])
        lower = np.minimum(lower, [(spout[:, 0] - spout[:, 2]).min(), -spout[:, 2].max(), BASE_Z])
        upper = np.maximum(upper, [0.0, 0.0, (spout[:, 1] + spout[:, 2]).max()])
    while True:  # reject slack that puts the object near the border of the ray tracer's box
        scale = np.exp(slack * SLACK_LOG_SCALE * rng.standard_normal())
        shift = slack * SLACK_SHIFT * rng.standard_normal(2)
        if max(np.abs(scale * lower[:2] + shift).max(), np.abs(scale * upper[:2] + shift).max()) <= 1.2:
            break
    return {
        "tube": absent_line,
        "tube_section": np.array([ABSENT, 0.0]),
        "spout": np.array([[0.0, 0.0, ABSENT], [0.1, 0.0, ABSENT]]),
        **shape,
        **_appearance(rng, kind, not shape["is_open"]),
        "kind": kind,
        "has_handle": has_handle,
        "half_extent_m": _largest_side_m(rng, kind) / BODY_EXTENT,
        "scale": scale,
        "shift": shift,
        "lower": lower,
        "upper": upper,
    }
