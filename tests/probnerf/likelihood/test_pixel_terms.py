"""The pixel likelihood: a density where it says so, silent where it must be, smooth everywhere."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderModel
from probnerf.likelihood.pixel_terms import faces_of_view, log_likelihood_one, pixel_terms
from probnerf.likelihood.position import pose_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.cylinder_scenes import grid_of_rays, scene
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.rendering.foam import FAR, Lattice
from probnerf.types import Observation, Rays

MODEL = CylinderModel()
LIKELIHOOD = Likelihood(Lattice(16))
# z_0 (handle length), z_1 (radius), a, b, x, y, log-scale, range offset, z: a handle at -y, to the picture's left
POSITION = jnp.array([0.3, 0.1, 0.1, -1.2, 0.0, 0.0, 0.0, 0.0, 0.0])


def _says(rays: Rays, status: int, **values) -> Observation:
    """An observation whose pixels all have one status and, unless told, no valid colour or range."""
    n = rays.origin.shape[0]
    fields = dict(
        rays=rays,
        status=jnp.full(n, status),
        rgb=jnp.full((n, 3), 0.5),
        rgb_valid=jnp.zeros(n, bool),
        range=jnp.full(n, 4.0),
        range_sigma=jnp.full(n, 0.02),
        range_valid=jnp.zeros(n, bool),
        limit=jnp.zeros(n),
        pose_sigma=jnp.array([0.1, 0.1, 0.1, 0.0, 0.0]),
        colour_count=n,
    )
    return Observation(**{**fields, **values})


@eqx.filter_jit
def _terms(observation: Observation, position=POSITION, model=MODEL, likelihood=LIKELIHOOD):
    weights, pose = split_position(model, likelihood, position, observation.pose_sigma)
    t = foam.crossings(observation.rays, likelihood.lattice)
    return pixel_terms(model.field, weights, pose, likelihood, observation, t)


@eqx.filter_jit
def _picture(rays: Rays, position=POSITION):
    weights, pose = split_position(MODEL, LIKELIHOOD, position, jnp.array([0.1, 0.1, 0.1, 0.0, 0.0]))
    return foam.render(MODEL.field, weights, rays, LIKELIHOOD.lattice, pose)


@pytest.fixture(scope="module")
def rays() -> Rays:
    return grid_of_rays(10, 6)


def _one_of_each(rays: Rays) -> list[int]:
    """Pixels of different opacity: an empty one, some half covered, a covered one."""
    opacity = np.asarray(_picture(rays).opacity)
    chosen = [int(np.abs(opacity - target).argmin()) for target in (0.0, 0.2, 0.5, 0.9, 1.0)]
    assert np.abs(opacity[chosen] - [0.0, 0.2, 0.5, 0.9, 1.0]).max() < 0.2
    return chosen


def test_mask_and_range_have_a_density_that_integrates_to_one(rays):
    # Normalised over {not object} + {object} x range; the outliers' uniform counts over one `outlier_span`.
    ranges = 4.0 + LIKELIHOOD.outlier_span * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    width = LIKELIHOOD.outlier_span / 4000
    for i in _one_of_each(rays):
        same = jax.tree.map(lambda a, i=i: jnp.broadcast_to(a[i], (4000, 3)), rays)
        hit = _says(same, OBJECT, range=jnp.asarray(ranges, jnp.float32), range_valid=jnp.ones(4000, bool))
        miss = _says(same, FREE, limit=jnp.full(4000, 0.5 * FAR))
        as_object = float(np.exp(np.asarray(_terms(hit), np.float64)).sum() * width)
        as_free = float(np.exp(_terms(miss)[0]))
        assert as_object + as_free == pytest.approx(1.0, abs=1e-4)
        # Without a range the two mask outcomes share the probability alone.
        assert float(np.exp(_terms(replace(hit, range_valid=jnp.zeros(4000, bool)))[0])) == pytest.approx(
            as_object, abs=1e-4
        )


def test_colour_has_a_density_that_integrates_to_one(rays):
    axis = (np.arange(24) + 0.5) / 24 * 1.6 - 0.3
    rgb = jnp.asarray(np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3), jnp.float32)
    opacity = np.asarray(_picture(rays).opacity)
    i = int(np.abs(opacity - 0.9).argmin())
    same = jax.tree.map(lambda a: jnp.broadcast_to(a[i], rgb.shape), rays)
    pixel = _says(same, OBJECT, rgb=rgb, rgb_valid=jnp.ones(len(rgb), bool))
    without = _terms(replace(pixel, rgb_valid=jnp.zeros(len(rgb), bool)))
    density = np.exp(np.asarray(_terms(pixel) - without, np.float64))
    assert density.sum() * (1.6 / 24) ** 3 == pytest.approx(1.0, abs=1e-3)
    mean = (density[:, None] * rgb).sum(0) / density.sum()
    np.testing.assert_allclose(mean, _picture(rays).colour[i] / opacity[i], atol=2e-3)


@pytest.mark.parametrize("status", [FREE, UNKNOWN])
def test_an_empty_stretch_says_its_transmittance(rays, status):
    i = _one_of_each(rays)[3]
    picture = _picture(rays)
    t, w = np.asarray(picture.t[i], np.float64), np.asarray(picture.weights[i], np.float64)
    limits = np.concatenate([[0.0], np.linspace(3.0, 5.0, 39)])
    same = jax.tree.map(lambda a: jnp.broadcast_to(a[i], (40, 3)), rays)
    said = np.exp(np.asarray(_terms(_says(same, status, limit=jnp.asarray(limits, jnp.float32))), np.float64))
    eps = LIKELIHOOD.mask_error
    expected = [eps + (1 - 2 * eps) * (1 - w[t <= limit].sum()) for limit in limits[1:]]
    np.testing.assert_allclose(said[1:], expected, atol=1e-5)
    assert said[0] == 1.0  # a limit of 0 says nothing
    assert said[1] == pytest.approx(1 - eps) and said[-1] < 0.2  # free before the object; hardly so behind it
    assert np.all(np.diff(said[1:]) <= 1e-7)


def test_a_limit_is_no_news_for_an_object_pixel(rays):
    pixel = _says(rays, OBJECT, range_valid=jnp.ones(60, bool))
    np.testing.assert_array_equal(_terms(pixel), _terms(replace(pixel, limit=jnp.full(60, 4.0))))


def test_a_range_offset_is_a_bias_that_all_ranges_share(rays):
    """log p(range | offset) is log p(range - offset | 0), and the offset says nothing where no range was measured."""
    model, likelihood = MODEL, LIKELIHOOD
    pixel = _says(rays, OBJECT, range_valid=jnp.ones(60, bool), pose_sigma=jnp.array([0.1, 0.1, 0.1, 0.05, 0.0]))
    t = foam.crossings(rays, likelihood.lattice)
    value = jax.jit(lambda o, q: log_likelihood_one(model, likelihood, o, t, q))
    biased = POSITION.at[7].set(1.5)
    moved = replace(pixel, range=pixel.range + 1.5 * 0.05)
    assert float(value(moved, biased)) == pytest.approx(float(value(pixel, POSITION)), rel=1e-5)
    assert abs(float(value(pixel, biased) - value(pixel, POSITION))) > 1.0
    unmeasured = replace(pixel, range_valid=jnp.zeros(60, bool))
    assert float(value(unmeasured, biased)) == float(value(unmeasured, POSITION))


def test_padding_says_exactly_nothing():
    model, likelihood, observation, _ = scene("seen", depth=True)
    count = observation.status.shape[0]
    # Padding: rays that start outside the lattice and point away from it.
    away = Rays(jnp.full((32, 3), 50.0), jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0]), (32, 3)))
    padding = _says(away, UNKNOWN)
    per_ray = [replace(o, pose_sigma=o.status, colour_count=0) for o in (observation, padding)]  # the padding last
    padded = jax.tree.map(lambda *parts: jnp.concatenate(parts), *per_ray)
    padded = replace(padded, pose_sigma=observation.pose_sigma, colour_count=observation.colour_count)

    @eqx.filter_jit
    def value_and_gradient(o, q):
        t = foam.crossings(o.rays, likelihood.lattice)
        return jax.value_and_grad(lambda v: log_likelihood_one(model, likelihood, o, t, v))(q)

    np.testing.assert_array_equal(_terms(padded, likelihood=likelihood)[count:], 0.0)
    (value, gradient), (expected, expected_gradient) = (value_and_gradient(o, POSITION) for o in (padded, observation))
    assert float(value) == pytest.approx(float(expected), abs=1e-3)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-5, atol=1e-3)
    _, alone = value_and_gradient(replace(padding, pose_sigma=observation.pose_sigma), POSITION)
    np.testing.assert_array_equal(alone, 0.0)


def test_a_surface_out_of_reach_behind_the_range_is_as_good_as_none(rays):
    pixel = _says(rays, OBJECT, range_valid=jnp.ones(60, bool), range=jnp.full(60, 3.0))
    likelihood = replace(LIKELIHOOD, reach=0.4, outlier=LIKELIHOOD.mask_error)
    t = np.asarray(faces_of_view(pixel, likelihood))
    assert t[t < FAR].max() <= 3.4 and np.all(t[foam.crossings(rays, LIKELIHOOD.lattice) <= 3.4] < FAR)
    # where an outlier in depth is as likely as one of the mask, asking on would have said the same
    weights, pose = split_position(MODEL, likelihood, POSITION, pixel.pose_sigma)
    near, far = (
        pixel_terms(MODEL.field, weights, pose, likelihood, pixel, jnp.asarray(faces))
        for faces in (t, foam.crossings(rays, LIKELIHOOD.lattice))
    )
    hits = np.asarray(foam.render(MODEL.field, weights, rays, LIKELIHOOD.lattice, pose).opacity) > 0.9
    assert np.sum(hits) > 10
    np.testing.assert_allclose(near, far, atol=0.02)


def test_what_is_not_valid_is_never_read():
    model, likelihood, observation, t = scene("seen", depth=True)
    spoilt = replace(
        observation,
        rgb=jnp.where(observation.rgb_valid[:, None], observation.rgb, jnp.nan),
        range=jnp.where(observation.range_valid, observation.range, jnp.nan),
    )
    both = eqx.filter_jit(
        lambda o: jax.value_and_grad(lambda v: log_likelihood_one(model, likelihood, o, t, v))(POSITION)
    )
    for a, b in zip(both(observation), both(spoilt), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_power_multiplies_the_log_likelihood():
    model, likelihood, observation, t = scene("hidden", depth=True)
    half = replace(likelihood, power=0.5)
    whole, scaled = (eqx.filter_jit(log_likelihood_one)(model, k, observation, t, POSITION) for k in (likelihood, half))
    assert float(scaled) == pytest.approx(0.5 * float(whole), rel=1e-6)


def test_gradients_are_those_of_finite_differences():
    with jax.enable_x64(True):
        model, likelihood, *arrays = scene("seen", depth=True)
        observation, t = jax.tree.map(lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a, arrays)
        value = jax.jit(lambda q: log_likelihood_one(model, likelihood, observation, t, q))
        q = POSITION.astype(jnp.float64) + 0.05
        gradient = jax.jit(jax.grad(value))(q)
        for i in range(4):
            step = 1e-6 * jnp.eye(9)[i]
            assert float(gradient[i]) == pytest.approx(
                float(value(q + step) - value(q - step)) / 2e-6, rel=1e-4, abs=1e-3
            )
        np.testing.assert_array_equal(gradient[4:], 0.0)  # x, y, log-scale are known in these scenes


def test_likelihood_and_gradient_are_finite_wherever_a_chain_may_go():
    model, likelihood, observation, t = scene("seen", depth=True)
    free = replace(observation, pose_sigma=jnp.array([0.3, 0.3, 0.3, 0.1, 0.1]))
    positions = jax.random.normal(jax.random.key(1), (64, 9)) * jnp.geomspace(0.1, 30.0, 64)[:, None]
    positions = jnp.concatenate([positions, jnp.zeros((1, 9)), 30.0 * jnp.ones((1, 9)), -30.0 * jnp.ones((1, 9))])
    values, gradients = jax.jit(
        jax.vmap(jax.value_and_grad(lambda q: log_likelihood_one(model, likelihood, free, t, q)))
    )(positions)
    assert np.isfinite(gradients).all() and np.isfinite(values).all()


@pytest.mark.parametrize("size", [0.1, 3.0, 100.0])  # at 100 every face is saturated or empty
def test_a_network_s_likelihood_and_gradient_are_finite(size):
    model = eqx.filter_jit(lambda: ProbNeRF(PRESETS["tiny"], jax.random.key(0)))()
    likelihood = Likelihood(Lattice(8), sample_delta=True)
    assert likelihood.dim(model) == 4 + 7 + model.field.size
    _, _, observation, _ = scene("seen", depth=True)
    free = replace(observation, pose_sigma=jnp.array([0.05, 0.05, 0.1, 0.02, 0.02]))
    t = foam.crossings(free.rays, likelihood.lattice)
    positions = size * jax.random.normal(jax.random.key(1), (8, likelihood.dim(model)))

    @eqx.filter_jit
    def both(model, q):
        return jax.vmap(jax.value_and_grad(lambda v: log_likelihood_one(model, likelihood, free, t, v)))(q)

    values, gradients = both(model, positions)
    assert np.isfinite(values).all() and np.isfinite(gradients).all()
    assert size == 100.0 or np.all(np.any(gradients[:, :4] != 0, axis=1))


def test_delta_moves_the_weights_by_root_alpha():
    model = eqx.filter_jit(lambda: ProbNeRF(PRESETS["tiny"], jax.random.key(0)))()
    position = jax.random.normal(jax.random.key(2), (4 + model.field.size,))
    settings = Likelihood(Lattice(8), sample_pose=False, sample_delta=True)
    weights, pose = split_position(model, settings, position, jnp.zeros(5))
    assert pose is None and settings.dim(model) == position.size
    np.testing.assert_allclose(weights - model.decode(position[:4]), 0.025 * position[4:], atol=1e-5)
    still = Likelihood(Lattice(8), sample_pose=False)
    assert still.dim(model) == 4 and Likelihood(Lattice(8)).dim(MODEL) == 9


def test_the_pose_is_read_off_its_latents_and_finite_at_the_origin():
    sigma = jnp.array([0.1, 0.2, 0.3, 0.0, 0.4])
    angles = jnp.linspace(-3.0, 3.0, 13)
    latents = jnp.stack(
        [2 * jnp.cos(angles), 2 * jnp.sin(angles), angles, -angles, 0.5 * angles, -angles, angles], axis=-1
    )
    pose = jax.jit(pose_of)(latents, sigma)
    np.testing.assert_allclose(pose.yaw, angles, atol=1e-6)
    np.testing.assert_allclose(pose.x, 0.1 * angles, atol=1e-6)
    np.testing.assert_allclose(pose.y, -0.2 * angles, atol=1e-6)
    np.testing.assert_allclose(pose.log_scale, 0.15 * angles, atol=1e-6)
    np.testing.assert_allclose(pose.z, 0.4 * angles, atol=1e-6)
    gradient = jax.jit(jax.grad(lambda q: pose_of(q, sigma).yaw))
    for tiny in (0.0, 1e-30, 1e-7, 1e-5):
        q = jnp.array([0.0, tiny, 0.0, 0.0, 0.0, 0.0, 0.0])
        assert np.isfinite(gradient(q)).all() and np.isfinite(gradient(q[jnp.array([1, 0, 2, 3, 4, 5, 6])])).all()


def test_a_hidden_handle_can_stand_anywhere_behind_the_body():
    model, likelihood, observation, t = scene("hidden", depth=True)
    value = jax.jit(jax.vmap(lambda q: log_likelihood_one(model, likelihood, observation, t, q)))

    def along(degrees, length):
        yaw = jnp.deg2rad(jnp.asarray(degrees))
        rest = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0]), (yaw.size, 3))
        shape = jnp.broadcast_to(jnp.array([length, 0.1]), (yaw.size, 2))
        return np.asarray(value(jnp.concatenate([shape, jnp.cos(yaw)[:, None], jnp.sin(yaw)[:, None], rest], axis=1)))

    behind = along(np.linspace(170.0, 190.0, 9), length=-2.0)
    assert np.ptp(behind) < 0.05
    assert np.all(along([0.0, 60.0, 90.0, 270.0, 300.0], length=0.5) < behind.min() - 10.0)
    # There, its length cannot be known either; nor does the radius of (a, b) ever matter.
    assert abs(along([180.0], length=-2.0) - along([180.0], length=0.0)).max() < 0.05
    q = jnp.stack([POSITION, POSITION.at[2:4].multiply(3.0)])
    values = value(q)
    assert float(values[0]) == pytest.approx(float(values[1]), rel=1e-5)
