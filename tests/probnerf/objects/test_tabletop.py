"""Laws of the tabletop family: exact distances, pictures that agree with them, and the canonical frame's promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.geometry import look_at, pinhole_rays
from probnerf.objects.ray_tracer import handle_occupancy, render_views, solid_occupancy, trace_batch
from probnerf.objects.tabletop import (
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    TabletopObject,
    part_distances,
    sample_object,
    sample_objects,
    signed_distance,
)
from probnerf.objects.tabletop_sampler import BOTTLE, CAN, CARTON, KINDS, MUG, PITCHER, REACH_LIMIT
from probnerf.types import BASE_Z, BODY_EXTENT

MANY = range(300)
_distance, _parts = jax.jit(signed_distance), jax.jit(part_distances)
_distances = jax.jit(jax.vmap(signed_distance, (0, None)))
_gradients = jax.jit(jax.vmap(jax.vmap(jax.grad(signed_distance, 1), (None, 0)), (0, None)))


@pytest.fixture(scope="module")
def many() -> TabletopObject:
    return sample_objects(MANY)


@pytest.fixture(scope="module")
def canonical() -> TabletopObject:
    return sample_objects(MANY, slack=0.0)


@pytest.fixture(scope="module")
def one_of_each(many: TabletopObject) -> TabletopObject:
    """One object of every kind, and in addition a mug and a pitcher with a handle."""
    kinds, handles = np.asarray(many.kind), np.asarray(many.has_handle)
    first = [int(np.flatnonzero(kinds == k)[0]) for k in range(len(KINDS))]
    first += [int(np.flatnonzero((kinds == k) & handles)[-1]) for k in (MUG, PITCHER)]
    return jax.tree.map(lambda leaf: leaf[np.array(first)], many)


def _cameras(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.1, 1.2, count)
    eye = 3.5 * np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1
    )
    return np.stack([look_at(e, np.array([0.0, 0.0, -0.1])) for e in eye])


def _float64(objects: TabletopObject, index: int) -> dict[str, np.ndarray]:
    return {k: np.asarray(v)[index].astype(np.float64) for k, v in vars(objects).items()}


def _slow_distance(o: dict[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """An independent float64 signed distance: segments by projection, insides by the winding angle."""
    p = (points - [*o["shift"], BASE_Z]) / o["scale"] + [0, 0, BASE_Z]

    def to_segments(q: np.ndarray, line: np.ndarray) -> np.ndarray:
        a, e = line[:-1], np.diff(line, axis=0)
        keep = (e**2).sum(-1) > 0
        a, e = a[keep], e[keep]
        t = np.clip(((q[..., None, :] - a) * e).sum(-1) / (e**2).sum(-1), 0, 1)
        return np.linalg.norm(q[..., None, :] - a - t[..., None] * e, axis=-1).min(-1)

    if o["kind"] == CARTON:
        half = o["box"][:3] - o["box"][3]
        q = np.abs(p - [0, 0, BASE_Z + o["box"][2]]) - half
        body = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - o["box"][3]
    else:
        rz = np.stack([np.hypot(p[..., 0], p[..., 1]), p[..., 2]], -1)
        loop = np.concatenate([o["outline"], o["outline"][:1]])
        corner = (loop - rz[..., None, :]) @ np.array([1, 1j])
        winding = np.angle(corner[..., 1:] * corner[..., :-1].conj()).sum(-1) / (2 * np.pi)
        body = to_segments(rz, o["outline"]) * np.where(np.abs(winding) > 0.5, -1, 1)
    if o["spout"][0, 2] > 0:  # a round cone is the hull of many balls
        for s in np.linspace(0, 1, 201):
            x, z, radius = (1 - s) * o["spout"][0] + s * o["spout"][1]
            body = np.minimum(body, np.sqrt((p[..., 0] - x) ** 2 + p[..., 1] ** 2 + (p[..., 2] - z) ** 2) - radius)
    if o["has_handle"]:
        radius, across = o["tube_section"]
        flat = to_segments(p[..., [0, 2]], o["tube"])
        body = np.minimum(body, np.hypot(flat, np.maximum(np.abs(p[..., 1]) - across, 0)) - radius)
    return body * o["scale"]


def test_seeds_are_disjoint_and_decide_the_object() -> None:
    assert not set(TRAIN_SEEDS) & set(VALIDATION_SEEDS) and not set(VALIDATION_SEEDS) & set(TEST_SEEDS)
    again, batch = sample_object(41), sample_objects([40, 41])
    for alone, stacked in zip(jax.tree.leaves(again), jax.tree.leaves(batch), strict=True):
        np.testing.assert_array_equal(alone, stacked[1])
    assert not np.array_equal(batch.paint[0], batch.paint[1])


def test_slack_moves_the_object_but_keeps_its_shape() -> None:
    loose, tight = sample_object(1), sample_object(1, slack=0.0)
    np.testing.assert_array_equal(loose.outline, tight.outline)
    assert float(tight.scale) == 1.0 and not np.any(tight.shift)
    points = jax.random.uniform(jax.random.key(0), (500, 3), minval=-1.0, maxval=1.0)
    base = jnp.array([0.0, 0.0, BASE_Z])
    moved = loose.scale * (points - base) + base + jnp.array([*loose.shift, 0.0])
    np.testing.assert_allclose(_distance(loose, moved), loose.scale * _distance(tight, points), atol=2e-6)


def test_distance_agrees_with_a_slow_one(one_of_each: TabletopObject) -> None:
    points = np.random.default_rng(1).uniform(-1.1, 1.1, (1500, 3))
    fast = np.asarray(_distances(one_of_each, jnp.asarray(points, jnp.float32)))
    for i in range(len(fast)):
        slow = _slow_distance(_float64(one_of_each, i), points)
        np.testing.assert_allclose(fast[i], slow, atol=1e-5)


def test_distance_is_1_lipschitz_with_unit_gradient_outside(one_of_each: TabletopObject) -> None:
    a, b = jax.random.uniform(jax.random.key(2), (2, 2000, 3), minval=-1.2, maxval=1.2)
    b = a + 0.1 * (b - a)
    far, near = (_distances(one_of_each, p) for p in (b, a))
    assert jnp.all(jnp.abs(far - near) <= jnp.linalg.norm(b - a, axis=-1) * (1 + 1e-4) + 1e-6)
    gradient = _gradients(one_of_each, a)
    norm = jnp.linalg.norm(gradient, axis=-1)
    # Only ties between parts or edges, of measure zero, may differ.
    assert jnp.mean(jnp.abs(jnp.where(near > 1e-3, norm, 1.0) - 1.0) > 1e-3) < 1e-3


def test_traced_hits_lie_on_the_surface_and_misses_stay_outside(one_of_each: TabletopObject) -> None:
    """Against a dense float64 march along every ray: the first crossing is the hit, and a miss never comes inside."""
    count = one_of_each.kind.shape[0]
    rays = [pinhole_rays(T, 17.0, 12) for T in _cameras(count, 3)]
    origins, directions = (np.stack(part) for part in zip(*rays, strict=True))
    hit, distance, _ = (np.asarray(leaf) for leaf in trace_batch(one_of_each, origins, directions))
    t = np.arange(2.2, 4.9, 0.006)
    for i in range(count):
        o = _float64(one_of_each, i)
        on_ray = _slow_distance(
            o, origins[i, :, None].astype(float) + t[:, None] * directions[i, :, None].astype(float)
        )
        closest = on_ray.min(-1)
        assert not np.any(hit[i] & (closest > 3e-3)), KINDS[int(o["kind"])]
        assert not np.any(~hit[i] & (closest < -3e-3)), KINDS[int(o["kind"])]
        clear = hit[i] & (closest < -3e-3)
        assert clear.sum() > 5
        at_hit = origins[i] + distance[i][:, None] * directions[i]
        np.testing.assert_allclose(_slow_distance(o, at_hit[hit[i]].astype(float)), 0.0, atol=1.5e-3)
        first = t[np.argmax(on_ray[clear] < 0.0, axis=-1)]
        # A march may step over a thin sliver that the tracer meets, never the other way round.
        assert np.all(distance[i][clear] <= first + 2e-3)
        before = np.where(t < distance[i][clear][:, None] - 2e-3, on_ray[clear], 1.0)
        assert before.min() > -1e-4


def test_pictures_agree_among_their_channels(one_of_each: TabletopObject) -> None:
    view = render_views(one_of_each, _cameras(one_of_each.kind.shape[0], 4), 60.0, 48)
    mask, rgb, distance = np.asarray(view.mask), np.asarray(view.rgb), np.asarray(view.range)
    assert np.all(np.isfinite(distance) == mask)
    assert np.all(rgb[~mask] == 1.0) and np.all((rgb >= 0.0) & (rgb <= 1.0))
    assert np.all(mask.reshape(len(mask), -1).mean(-1) > 0.02)
    assert np.all((distance[mask] > 1.5) & (distance[mask] < 5.5))


def test_colour_does_not_depend_on_the_view(one_of_each: TabletopObject) -> None:
    """A surface point seen by two cameras has one colour (the light is fixed to the object)."""
    count = one_of_each.kind.shape[0]
    rays = [pinhole_rays(T, 22.0, 16) for T in _cameras(count, 5)]
    origins, directions = (np.stack(part) for part in zip(*rays, strict=True))
    hit, distance, rgb = (np.asarray(leaf) for leaf in trace_batch(one_of_each, origins, directions))
    moved = origins + np.array([0.15, -0.1, 0.1], np.float32)
    to_point = origins + np.where(hit, distance, 3.5)[..., None] * directions - moved
    length = np.linalg.norm(to_point, axis=-1)
    seen, other, other_rgb = (np.asarray(x) for x in trace_batch(one_of_each, moved, to_point / length[..., None]))
    for i in range(count):
        same = hit[i] & seen[i] & (np.abs(other[i] - length[i]) < 1e-3)
        change = np.abs(rgb[i] - other_rgb[i])[same].max(-1)
        assert same.sum() > 0.6 * hit[i].sum()
        assert np.mean(change < 0.03) > 0.9  # the edges of a pattern excepted


def test_bodies_stand_on_the_plane_and_have_the_agreed_extent(canonical: TabletopObject) -> None:
    for i in range(len(MANY)):
        o = _float64(canonical, i)
        if o["kind"] == CARTON:
            width, height = 2 * o["box"][:2].max(), 2 * o["box"][2]
        else:
            width, height = 2 * o["outline"][:, 0].max(), np.ptp(o["outline"][:, 1])
            assert o["outline"][:, 1].min() == pytest.approx(BASE_Z) and o["outline"][:, 0].min() >= 0.0
        assert max(width, height) == pytest.approx(BODY_EXTENT, abs=1e-5)
        assert 0.04 <= max(width, height) * o["half_extent_m"] <= 0.301
        assert np.all(np.abs([o["lower"][:2], o["upper"][:2]]) <= REACH_LIMIT + 1e-6) and o["upper"][2] <= 1.0
    points = jax.random.uniform(
        jax.random.key(6), (1000, 3), minval=jnp.array([-1.3, -1.3, -1.0]), maxval=jnp.array([1.3, 1.3, 1.2])
    )
    inside = _distances(canonical, points) < 0.0
    outside_box = jnp.any(
        (points < canonical.lower[:, None] - 1e-5) | (points > canonical.upper[:, None] + 1e-5), axis=-1
    )
    assert not jnp.any(inside & outside_box)


def test_handles_point_to_plus_x_and_leave_a_hole(canonical: TabletopObject) -> None:
    handled = np.flatnonzero(np.asarray(canonical.has_handle))[:8]
    for i in handled:
        obj = jax.tree.map(lambda leaf, i=i: leaf[i], canonical)
        voxels = np.argwhere(np.asarray(handle_occupancy(obj, 32)))
        centres = -1.0 + (voxels + 0.5) * 2 / 32
        azimuth = np.arctan2(centres[:, 1].mean(), centres[:, 0].mean())
        assert len(voxels) > 30 and abs(azimuth) < 0.02
        # A horizontal row of points in y = 0 from the wall outwards meets free space before the handle.
        tube = np.asarray(obj.tube)
        z = tube[len(tube) // 2, 1]
        row = np.stack([np.linspace(0.1, 1.2, 400), np.zeros(400), np.full(400, z)], -1).astype(np.float32)
        body, handle = (np.asarray(d) for d in _parts(obj, row))
        wall_end, handle_start = np.flatnonzero(body < 0).max(), np.flatnonzero(handle < 0).min()
        assert handle_start > wall_end and np.minimum(body, handle)[wall_end:handle_start].max() > 0.015
        # It is attached: near both ends of its centre line body and handle overlap.
        ends = jnp.stack([jnp.array([x, 0.0, z]) for x, z in (tube[0], tube[-1])])
        assert jnp.all(_parts(obj, ends)[0] < obj.tube_section[0])


def test_frequencies_and_solids_by_kind(many: TabletopObject) -> None:
    kinds, handles, is_open = (np.asarray(leaf) for leaf in (many.kind, many.has_handle, many.is_open))
    assert np.all(np.bincount(kinds, minlength=len(KINDS)) > 15)
    assert set(kinds[handles]) == {MUG, PITCHER}
    assert not is_open[(kinds == CAN) | (kinds == BOTTLE) | (kinds == CARTON)].any()
    assert 0.15 < is_open[kinds == PITCHER].mean() < 0.95
    assert np.all(np.bincount(np.asarray(many.texture), minlength=4) > 30)


def test_solid_truth_contains_what_the_distance_contains(one_of_each: TabletopObject) -> None:
    grid = 32
    centre = -1.0 + (np.arange(grid) + 0.5) * 2 / grid
    points = jnp.asarray(np.stack(np.meshgrid(centre, centre, centre, indexing="ij"), -1), jnp.float32)
    for i in range(one_of_each.kind.shape[0]):
        obj = jax.tree.map(lambda leaf, i=i: leaf[i], one_of_each)
        solid, distance = np.asarray(solid_occupancy(obj, grid)), np.asarray(_distance(obj, points))
        half_diagonal = np.sqrt(3) / grid
        assert np.all(solid[distance <= 0.0]) and not np.any(solid[distance > half_diagonal + 1e-6])
        assert not np.any(np.asarray(handle_occupancy(obj, grid)) & ~solid)
