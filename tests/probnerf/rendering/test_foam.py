"""The foam renderer against a slow loop in float64, its gradients against finite differences, and its edge cases."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.mlp import MLPField
from probnerf.prior.networks import PRESETS
from probnerf.rendering import foam
from probnerf.rendering.foam import FAR, Lattice
from probnerf.types import BASE_Z, Pose, Rays

POSE = (0.7, 0.08, -0.05, -0.2, -0.03)  # yaw, x, y, log-scale, z


class Slow:
    """One ray, one crossing, one neuron layer at a time, in float64: written from the definitions alone."""

    def __init__(self, field: MLPField, weights: np.ndarray, lattice: Lattice, pose: tuple[float, ...] | None = None):
        self.field, self.lattice, self.pose = field, lattice, pose
        self.layers, start = [], 0
        for shape in field.shapes:
            end = start + int(np.prod(shape))
            self.layers.append(weights[start:end].astype(np.float64).reshape(shape))
            start = end

    def crossings(self, origin: np.ndarray, direction: np.ndarray, shift: np.ndarray | float = 0.0) -> list[float]:
        found = []
        count = int(self.lattice.extent * self.lattice.cubes / 2)
        for axis in range(3):
            if abs(direction[axis]) < 1e-9:
                continue
            for k in range(-count, count + 1):
                face = k * 2 / self.lattice.cubes + np.broadcast_to(shift, 3)[axis]
                t = (face - origin[axis]) / direction[axis]
                point = origin + t * direction
                point[axis] = face
                low, high = np.array([-self.lattice.extent] * 2 + [BASE_Z - self.lattice.below]), self.lattice.extent
                if t > 0 and np.all(point > low - 1e-6) and np.all(point < high + 1e-6):
                    found.append(t)
        return sorted(found)[: self.lattice.crossings]

    def at(self, point: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray]:
        """Density (windowed) and colour at a point of the view frame."""
        if self.pose is not None:
            yaw, x, y, log_scale, z = self.pose
            c, s = np.cos(yaw), np.sin(yaw)
            turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            base = np.array([0, 0, BASE_Z])
            point = turn @ (point - base - [x, y, z]) / np.exp(log_scale) + base
            direction = turn @ direction
        field = self.field
        k0, b0, k1, b1, k2, b2, k3, b3, k4, b4, k5, b5, *fitted = self.layers
        place: Any = point
        if field.fitted:
            base = np.array([0, 0, BASE_Z])
            place = (point - base - fitted[1]) * np.exp(fitted[0]) + base
        if field.radial:
            place = [*place, np.sqrt(place[0] ** 2 + place[1] ** 2 + 1e-4)]
        position = _encode(np.asarray(place), field.octaves)
        hidden = np.maximum(np.maximum(position @ k0 + b0, 0) @ k1 + b1, 0)
        u = np.clip(1 - max(np.abs(point).max() - 1, 5 * (BASE_Z - 0.02 - point[2])) / 0.1, 0, 1)
        sigma = field.density_scale * np.logaddexp(0, (hidden @ k2 + b2)[0]) * u**2 * (3 - 2 * u)
        inputs = np.concatenate([position, _encode(direction, field.direction_octaves), [np.log1p(sigma)]])
        hidden = np.maximum(np.maximum(inputs @ k3 + b3, 0) @ k4 + b4, 0)
        return sigma, 1 / (1 + np.exp(-(hidden @ k5 + b5)))

    def render(self, rays: Rays) -> tuple[np.ndarray, ...]:
        """Opacity [n], colour [n, 3] and opacity-weighted distance [n]."""
        scale = 1.0 if self.pose is None else np.exp(self.pose[3])
        rows = []
        for origin, direction in zip(_f64(rays.origin), _f64(rays.direction), strict=True):
            transmittance, colour, distance = 1.0, np.zeros(3), 0.0
            for t in self.crossings(origin, direction):
                sigma, c = self.at(origin + t * direction, direction)
                alpha = 1 - np.exp(-scale * sigma / self.lattice.cubes)
                colour = colour + transmittance * alpha * c
                distance += transmittance * alpha * t
                transmittance *= 1 - alpha
            rows.append((1 - transmittance, colour, distance))
        return tuple(np.array(column) for column in zip(*rows, strict=True))


def _f64(a) -> np.ndarray:
    return np.asarray(a).astype(np.float64)


def _encode(x: np.ndarray, octaves: int) -> np.ndarray:
    return np.concatenate([x, *(f(2.0**j * np.pi * x) for j in range(octaves) for f in (np.sin, np.cos))])


_render = eqx.filter_jit(foam.render)  # settings are static, arrays are traced
_crossings = eqx.filter_jit(foam.crossings)


def _rays(count: int, seed: int = 0, distance: float = 4.0) -> Rays:
    """Random rays towards the cube; among them ones that miss, run along faces, meet edges and start inside."""
    rng = np.random.default_rng(seed)
    origin = rng.standard_normal((count, 3))
    origin[:, 2] = np.abs(origin[:, 2])
    origin *= distance / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.uniform(-0.8, 0.8, (count, 3)) - origin
    special = [
        ((3.0, 0.25, 0.25), (-1, 0, 0)),  # along the edge of two faces
        ((3.0, 0.25, 0.1), (-1, 0, 0)),  # in a face
        ((3.0, 3.0, 0.1), (-1, -1, 0)),  # from edge to edge
        ((0.1, 0.3, 5.0), (0, 0, -1)),
        ((0.1, -0.2, 0.05), (0.3, 0.5, -0.4)),  # from inside
        ((4.0, 0.0, 2.0), (0, 0, 1)),  # misses
        ((4.0, 0.0, 0.0), (1, 0, 0)),  # looks away
    ]
    for i, (o, d) in enumerate(special[: count // 2]):
        origin[i], direction[i] = o, d
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Rays(jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32))


def _weights(field: MLPField, seed: int, bias: float = -4.0) -> np.ndarray:
    """Random weights of a translucent field: many faces share each ray."""
    rng = np.random.default_rng(seed)
    parts = []
    for i, shape in enumerate(field.shapes):
        fan_in = shape[0] if len(shape) == 2 else field.shapes[i - 1][0]
        parts.append(
            rng.standard_normal(int(np.prod(shape))) * np.sqrt(2.0 / fan_in) * (1.0 if len(shape) == 2 else 0.3)
        )
    parts[5] += bias
    return np.concatenate(parts).astype(np.float32)


@pytest.mark.parametrize(
    ("preset", "rays", "lattice", "pose"),
    [
        ("tiny", 15, Lattice(8), None),
        ("tiny", 15, Lattice(8, extent=1.25), POSE),
        ("tiny", 1, Lattice(6, max_crossings=7), None),
        ("small", 5, Lattice(32, extent=1.1, below=0.15), POSE),
    ],
)
def test_rendering_is_exact(preset, rays, lattice, pose):
    field = PRESETS[preset].field
    weights, rays = _weights(field, 1), _rays(rays, seed=2)
    moved = None if pose is None else Pose(*(jnp.float32(v) for v in pose))
    picture = _render(field, weights, rays, lattice, moved)
    opacity, colour, distance = Slow(field, weights, lattice, pose).render(rays)
    assert 0.1 < np.median(opacity[opacity > 0]) < 0.9
    np.testing.assert_allclose(picture.opacity, opacity, atol=2e-5)
    np.testing.assert_allclose(picture.colour, colour, atol=2e-5)
    hit = opacity > 1e-4
    np.testing.assert_allclose(picture.distance[hit], distance[hit] / opacity[hit], rtol=2e-5)
    assert np.all(np.asarray(picture.distance)[opacity == 0.0] == FAR)


@pytest.mark.parametrize("distance", [1.5, 4.0, 10.0])
def test_crossings_are_exact_for_a_shifted_lattice_from_near_and_far(distance):
    lattice = Lattice(16)
    slow = Slow(PRESETS["tiny"].field, np.zeros(PRESETS["tiny"].field.size), lattice)
    rays, shift = _rays(201, seed=3, distance=distance), np.array([0.05, -0.03, 0.0625], np.float32)
    for moved in (0.0, shift):
        t = np.asarray(_crossings(rays, lattice, moved))
        assert np.all(np.diff(t, axis=1) >= 0)
        for i, (origin, direction) in enumerate(zip(_f64(rays.origin), _f64(rays.direction), strict=True)):
            expected = slow.crossings(origin, direction, _f64(moved))
            assert np.sum(t[i] < FAR) == len(expected)
            np.testing.assert_allclose(t[i, : len(expected)], expected, rtol=1e-6, atol=1e-5)
    assert foam.count_crossings(rays, lattice) == max(
        len(slow.crossings(o, d)) for o, d in zip(_f64(rays.origin), _f64(rays.direction), strict=True)
    )


def test_gap_before_is_the_distance_to_the_previous_crossing():
    t = jnp.array([[1.0, 1.1, 1.1, 1.4, FAR, FAR], [2.0, 2.5, FAR, FAR, FAR, FAR], [FAR] * 6])
    expected = [[0.1, 0.1, 0.0, 0.3, 0, 0], [0.5, 0.5, 0, 0, 0, 0], [0] * 6]
    np.testing.assert_allclose(jax.jit(foam.gap_before)(t), expected, atol=1e-6)
    along = Rays(jnp.array([[3.0, 0.01, 0.01]]), jnp.array([[-1.0, 0.0, 0.0]]))
    t = _crossings(along, Lattice(16))
    np.testing.assert_allclose(foam.gap_before(t)[t < FAR], 2 / 16, rtol=1e-5)


def test_the_window_is_one_in_the_cube_and_zero_beyond_its_margin():
    inside = jnp.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [0.0, 0.9, BASE_Z]])
    outside = jnp.array([[1.1, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, BASE_Z - 0.05], [1e4, 1e4, 1e4]])
    np.testing.assert_array_equal(foam.window(inside), 1.0)
    np.testing.assert_array_equal(foam.window(outside), 0.0)
    along = foam.window(jnp.stack([jnp.linspace(1.0, 1.1, 101), jnp.zeros(101), jnp.zeros(101)], axis=-1))
    assert np.all(np.diff(along) <= 0) and np.abs(np.diff(along)).max() < 0.02  # falls without a jump
    assert abs(float(jax.grad(lambda x: foam.window(jnp.array([x, 0.0, 0.0])))(1.0999))) < 0.1


def test_weights_and_transmittance_sum_to_one():
    rng = np.random.default_rng(4)
    t = jnp.asarray(np.sort(rng.uniform(1, 5, (40, 24)), axis=1).astype(np.float32)).at[::3, 10:].set(FAR)
    for size in (1e-6, 1.0, 30.0, 1e4):
        sigma = jnp.asarray((size * rng.exponential(size=t.shape)).astype(np.float32))
        faces = jax.jit(foam.composite)(sigma, t, jnp.float32(1 / 16))
        total = jnp.sum(jnp.exp(faces.log_weight), axis=-1) + jnp.exp(faces.log_transmittance[:, -1])
        np.testing.assert_allclose(total, 1.0, atol=3e-6)
        assert np.all(np.diff(faces.log_transmittance, axis=1) <= 0)


def _weighing(rays: Rays, seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random multipliers of opacity, colour and distance: one scalar of a picture."""
    rng = np.random.default_rng(seed)
    n = rays.origin.shape[0]
    return rng.standard_normal(n), rng.standard_normal((n, 3)), 0.2 * rng.standard_normal(n)


def _scalar(field, weights, pose, rays: Rays, lattice: Lattice):
    a, b, c = (jnp.asarray(v, jnp.float32) for v in _weighing(rays))
    picture = foam.render(field, weights, rays, lattice, pose)
    t = jnp.where(picture.t < FAR, picture.t, 0.0)
    return jnp.sum(a * picture.opacity) + jnp.sum(b * picture.colour) + jnp.sum(c[:, None] * picture.weights * t)


def _scalar64(field, weights, pose, rays: Rays, lattice: Lattice) -> float:
    return float(
        sum(
            np.sum(m * v)
            for m, v in zip(_weighing(rays), Slow(field, weights, lattice, pose).render(rays), strict=True)
        )
    )


def test_gradients_by_weights_and_by_pose_are_those_of_the_reference():
    field, lattice, rays = PRESETS["tiny"].field, Lattice(8, extent=1.25), _rays(9, seed=6)
    weights = _weights(field, 7)
    pose = Pose(*(jnp.float32(v) for v in POSE))
    by_weights, by_pose = jax.jit(jax.grad(lambda w, p: _scalar(field, w, p, rays, lattice), argnums=(0, 1)))(
        jnp.asarray(weights), pose
    )
    step = 1e-6
    for direction in np.random.default_rng(8).standard_normal((4, weights.size)):
        ahead = _scalar64(field, weights + step * direction, POSE, rays, lattice)
        behind = _scalar64(field, weights - step * direction, POSE, rays, lattice)
        assert float(by_weights @ direction) == pytest.approx((ahead - behind) / (2 * step), rel=1e-3, abs=1e-3)
    for i, value in enumerate((by_pose.yaw, by_pose.x, by_pose.y, by_pose.log_scale, by_pose.z)):
        ends = [_scalar64(field, weights, _nudged(i, sign * step), rays, lattice) for sign in (1, -1)]
        assert float(value) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-3, abs=1e-3)


def _nudged(index: int, by: float) -> tuple[float, ...]:
    return tuple(value + by * (i == index) for i, value in enumerate(POSE))


class Uniform(eqx.Module):
    """The same density everywhere; weights: (density, brightness)."""

    def density(self, weights, points):
        return weights[0] * jnp.ones(points.shape[:-1])

    def colour(self, weights, points, directions, sigma):
        return weights[1] * jnp.ones(points.shape)


@pytest.mark.parametrize("sigma", [0.0, 1e-12, 1.0, 1e4, 1e8])
def test_gradients_are_finite_in_empty_and_in_saturated_space(sigma):
    rays, lattice = _rays(15, seed=9), Lattice(8)
    weights = jnp.array([sigma, 0.5])

    def both(w):
        t = foam.crossings(rays, lattice)
        faces = foam.composite(jnp.broadcast_to(w[0], t.shape), t, jnp.float32(1 / 8))
        logarithms = jax.nn.logsumexp(faces.log_weight, axis=-1) + faces.log_transmittance[:, -1]
        return _scalar(Uniform(), w, None, rays, lattice) + 1e-3 * jnp.sum(jnp.where(t[:, 0] < FAR, logarithms, 0.0))

    value, gradient = jax.jit(jax.value_and_grad(both))(weights)
    assert np.isfinite(value) and np.isfinite(gradient).all()
    opacity = np.asarray(_render(Uniform(), weights, rays, lattice).opacity)
    assert np.all((opacity >= 0) & (opacity <= 1))
    if sigma >= 1e4:
        assert np.all(np.isin(opacity, (0.0, 1.0)))  # saturated or missed


@pytest.mark.parametrize(
    "pose", [(0.3, 40.0, 0, 0, 0), (0.3, 0.0, 0, -6.0, 0), (0.3, 0.0, 0, 6.0, 0), (1e4, 0.5, 0.5, 0.0, 0)]
)
def test_gradients_are_finite_for_points_far_outside_the_cube(pose):
    field, lattice, rays = PRESETS["tiny"].field, Lattice(8, extent=1.25), _rays(9, seed=10)
    weights = jnp.asarray(_weights(field, 11))
    moved = Pose(*(jnp.float32(v) for v in pose))
    gradients = jax.jit(jax.grad(lambda w, p: _scalar(field, w, p, rays, lattice), argnums=(0, 1)))(weights, moved)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    if pose[1] == 40.0:  # the whole object is out of sight
        assert not np.any(_render(field, weights, rays, lattice, moved).opacity > 0)


def test_a_ray_that_misses_everything_renders_nothing():
    rays = Rays(jnp.array([[4.0, 0.0, 2.0], [50.0, 50.0, 50.0]]), jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))
    picture = _render(Uniform(), jnp.array([100.0, 1.0]), rays, Lattice(8))
    assert np.all(picture.t == FAR)
    np.testing.assert_array_equal(picture.opacity, 0.0)
    np.testing.assert_array_equal(picture.colour, 0.0)
    np.testing.assert_array_equal(picture.distance, FAR)


def test_a_picture_in_chunks_is_the_picture():
    field, lattice, rays = PRESETS["tiny"].field, Lattice(8), _rays(23, seed=12)
    weights = jnp.asarray(_weights(field, 13))
    whole, parts = (
        _render(field, weights, rays, lattice),
        eqx.filter_jit(foam.render_picture)(field, weights, rays, lattice, chunk=8),
    )
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
