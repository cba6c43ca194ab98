"""The fused kernel says what plain JAX says in float64, with its gradients: any sizes, rays, instruction set."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.mlp import MLPField
from probnerf.kernel import library
from probnerf.likelihood import kernel_call
from probnerf.likelihood.dispatch import log_likelihood, plain_log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view, pixel_terms
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.prior.checkpoint import load_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering.foam import Lattice, window
from probnerf.shapes import explained, opacity_grids
from probnerf.types import Observation, Pose, Rays

ISAS = ("avx512", "avx2", "plain")
FIELDS = {
    "tiny": PRESETS["tiny"].field,
    "small": PRESETS["small"].field,
    "paper": PRESETS["paper"].field,
    "odd": MLPField(width=21, octaves=4, direction_octaves=2, radial=True),
    "fitted": MLPField(width=80, octaves=1, direction_octaves=0, fitted=True),
}


@pytest.fixture(autouse=True)
def built() -> None:
    if not library.available():
        pytest.skip("the kernel is not built: there was no C++ compiler")


def view(rays: int, colour: int, seed: int = 0) -> Observation:
    """A view of every kind of pixel: with and without range and colour, free, unknown, padding; some miss the cube."""
    rng = np.random.default_rng(seed)
    origin = np.array([2.6, 0.2, 0.9]) + 0.05 * rng.normal(size=(rays, 3))
    aim = rng.uniform(-0.8, 0.8, (rays, 3)) + (rng.random((rays, 1)) < 0.1) * np.array([0.0, 0.0, 9.0])
    direction = (aim - origin) / np.linalg.norm(aim - origin, axis=1, keepdims=True)
    status = rng.choice([OBJECT, OBJECT, OBJECT, FREE, UNKNOWN], rays)
    status[colour:] = rng.choice([FREE, UNKNOWN], rays - colour)
    limit = np.where(status == OBJECT, 0.0, rng.uniform(1.5, 4.0, rays)) * (rng.random(rays) < 0.8)
    return Observation(
        rays=Rays(jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32)),
        status=jnp.asarray(status),
        rgb=jnp.asarray(rng.random((rays, 3)), jnp.float32),
        rgb_valid=jnp.asarray(rng.random(rays) < 0.8),
        range=jnp.asarray(rng.uniform(1.6, 3.5, rays), jnp.float32),
        range_sigma=jnp.full(rays, 0.02, jnp.float32),
        range_valid=jnp.asarray(rng.random(rays) < 0.8),
        limit=jnp.asarray(limit, jnp.float32),
        pose_sigma=jnp.asarray([0.05, 0.05, 0.1, 0.02, 0.03]),
        colour_count=colour,
    )


def drawn(field: MLPField, particles: int, density: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Random weights (with so much added to the density's last bias) and poses with a range offset."""
    rng = np.random.default_rng(particles)
    weights = rng.normal(size=(particles, field.size)) * field.weight_scale
    last = sum(int(np.prod(shape)) for shape in field.shapes[:6]) - 1
    weights[:, last] += density
    pose = rng.normal(size=(particles, 6)) * [1.5, 0.05, 0.05, 0.1, 0.03, 0.02]
    return weights.astype(np.float32), pose.astype(np.float32)


def exact(field, likelihood, observation, t, weights, pose, pixel_weight=1.0):
    """Values and gradients of `pixel_terms` in float64, summed with a weight for each pixel."""
    with jax.enable_x64(True):

        def double(tree):
            return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64) if a.dtype == jnp.float32 else a, tree)

        def one(w, p):
            terms = pixel_terms(field, w, Pose(*p[:5]), likelihood, double(observation), double(t), p[5])
            return jnp.sum(pixel_weight * terms)

        found = jax.jit(jax.vmap(jax.value_and_grad(one, argnums=(0, 1))))(*double((weights, pose)))
        return jax.tree.map(np.asarray, (found[0], *found[1]))


def assert_close(found, expected) -> None:
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
    for slope, true in zip(found[1:], expected[1:], strict=True):
        scale = np.abs(true).max(axis=-1, keepdims=True)  # a gradient's small entries are differences of large ones
        np.testing.assert_allclose(slope / scale, true / scale, atol=1e-4)


@pytest.mark.parametrize("name", FIELDS)
def test_it_is_the_plain_computation_for_fields_of_any_size(name: str) -> None:
    field, observation = FIELDS[name], view(37, 20)
    likelihood = Likelihood(Lattice(8, 1.1, below=0.15), reach=0.3)
    t = faces_of_view(observation, likelihood)
    weights, pose = drawn(field, 3)
    found = jax.jit(lambda w, p: kernel_call.call(field, likelihood, observation, t, w, p))(weights, pose)
    assert_close(found, exact(field, likelihood, observation, t, weights, pose))


@pytest.mark.parametrize(
    ("rays", "colour", "cubes", "density"), [(1, 1, 32, 0.0), (5, 0, 16, 0.0), (64, 32, 64, -9.0), (33, 33, 24, 6.0)]
)
def test_odd_counts_long_rays_empty_and_saturated_ones(rays: int, colour: int, cubes: int, density: float) -> None:
    field, observation = FIELDS["odd"], view(rays, colour, seed=rays)
    likelihood = Likelihood(Lattice(cubes, 1.1, below=0.15), outlier=0.01, wall_sigma=0.05)
    t = faces_of_view(observation, likelihood)
    weights, pose = drawn(field, 2, density)
    found = kernel_call.call(field, likelihood, observation, t, jnp.asarray(weights), jnp.asarray(pose))
    assert_close(found, exact(field, likelihood, observation, t, weights, pose))


def test_sharp_walls_of_which_few_crossings_count() -> None:
    prior, observation = load_prior(None).model, view(96, 48)
    likelihood = Likelihood(Lattice(32, 1.1, below=0.15), outlier=0.01, wall_sigma=0.05)
    t = faces_of_view(observation, likelihood)
    weights = jax.vmap(prior.decode)(jax.random.normal(jax.random.key(0), (8, prior.latent)))
    pose = drawn(prior.field, 8)[1]

    def plain(w, p):
        return jnp.sum(pixel_terms(prior.field, w, Pose(*p[:5]), likelihood, observation, t, p[5]))

    given = weights, jnp.asarray(pose)
    expected = exact(prior.field, likelihood, observation, t, *given)
    found = kernel_call.call(prior.field, likelihood, observation, t, *given)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
    slopes = jax.jit(jax.vmap(jax.grad(plain, argnums=(0, 1))))(*given)
    for slope, single, true in zip(found[1:], slopes, expected[1:], strict=True):
        scale = np.abs(true).max(axis=-1, keepdims=True)
        # sharp walls magnify single precision itself: here it is 1.1e-4 from the truth
        rounding = np.max(np.abs(single - true) / scale)
        assert np.max(np.abs(slope - true) / scale) <= max(1e-4, 1.5 * rounding)


def test_pixels_have_weights_and_values_alone_are_the_same() -> None:
    field, observation = FIELDS["odd"], view(37, 20)
    likelihood = Likelihood(Lattice(8, 1.1, below=0.15))
    t = faces_of_view(observation, likelihood)
    weights, pose = drawn(field, 3)
    pixel_weight = np.random.default_rng(0).uniform(0.0, 3.0, 37).astype(np.float32)
    args = (field, likelihood, observation, t, jnp.asarray(weights), jnp.asarray(pose), jnp.asarray(pixel_weight))
    found = kernel_call.call(*args)
    assert_close(found, exact(field, likelihood, observation, t, weights, pose, pixel_weight))
    alone = kernel_call.call(*args, gradients=False)
    np.testing.assert_array_equal(alone[0], found[0])
    assert alone[1].size == alone[2].size == 0
    for threads in (2, 64):  # a particle in parts
        one = kernel_call.call(*args[:4], args[4][:1], args[5][:1], args[6], threads=threads, gradients=False)
        np.testing.assert_allclose(one[0], found[0][:1], rtol=1e-6)


def test_a_view_that_says_nothing_is_zero() -> None:
    observation = view(8, 4)
    silent = replace(observation, status=jnp.full(8, UNKNOWN), limit=jnp.zeros(8))
    likelihood = Likelihood(Lattice(8))
    weights, pose = drawn(FIELDS["tiny"], 2)
    found = kernel_call.call(FIELDS["tiny"], likelihood, silent, faces_of_view(silent, likelihood), weights, pose)
    assert not any(np.asarray(a).any() for a in found)


@pytest.mark.parametrize("what", [np.nan, np.inf])
def test_what_is_no_number_gives_none(what: float) -> None:
    field, observation = FIELDS["small"], view(9, 5)
    likelihood = Likelihood(Lattice(8))
    t = faces_of_view(observation, likelihood)
    weights, pose = drawn(field, 3)
    weights[0, 7], weights[1, -1] = what, what
    values = np.asarray(kernel_call.call(field, likelihood, observation, t, jnp.asarray(weights), jnp.asarray(pose))[0])
    assert np.isnan(values[:2]).all() and np.isfinite(values[2])
    pose[2, 3] = np.nan
    assert np.isnan(
        kernel_call.call(field, likelihood, observation, t, jnp.asarray(weights), jnp.asarray(pose))[0]
    ).all()


def test_weights_of_another_field_are_refused() -> None:
    observation, likelihood = view(9, 5), Likelihood(Lattice(8))
    t = faces_of_view(observation, likelihood)
    weights, pose = map(jnp.asarray, drawn(FIELDS["tiny"], 2))
    with pytest.raises(
        jax.errors.JaxRuntimeError, match=f"has {FIELDS['odd'].size} weights, not {FIELDS['tiny'].size}"
    ):
        jax.block_until_ready(kernel_call.call(FIELDS["odd"], likelihood, observation, t, weights, pose))


def test_neither_threads_nor_the_instruction_set_change_the_answer() -> None:
    field, observation = FIELDS["small"], view(37, 20)
    likelihood = Likelihood(Lattice(16, 1.1, below=0.15))
    t = faces_of_view(observation, likelihood)
    weights, pose = map(jnp.asarray, drawn(field, 5))
    call = partial(kernel_call.call, field, likelihood, observation, t, weights, pose)
    whole = call(threads=1)
    for threads in (2, 3, 5):
        for a, b in zip(call(threads=threads), whole, strict=True):
            np.testing.assert_array_equal(a, b)  # to the last bit
    expected = exact(field, likelihood, observation, t, weights, pose)
    for isa in ISAS:
        try:
            found = jax.block_until_ready(call(isa=isa))
        except jax.errors.JaxRuntimeError as error:
            assert "no instruction set" in str(error) and isa != "plain"
            continue
        assert_close(found, expected)
    with pytest.raises(jax.errors.JaxRuntimeError, match="no instruction set nonesuch"):
        jax.block_until_ready(call(isa="nonesuch"))


@pytest.mark.parametrize("particles", [1, 2, 3])
def test_threads_share_a_particle_where_there_are_more_of_them(particles: int) -> None:
    field, observation = FIELDS["small"], view(37, 20)
    likelihood = Likelihood(Lattice(16, 1.1, below=0.15))
    t = faces_of_view(observation, likelihood)
    weights, pose = map(jnp.asarray, drawn(field, particles))
    call = partial(kernel_call.call, field, likelihood, observation, t, weights, pose)
    whole = call(threads=1)
    for threads in (2, 4, 64):  # 64: more than tiles
        found, again = call(threads=threads), call(threads=threads)
        assert_close(found, whole)
        for a, b in zip(found, again, strict=True):
            np.testing.assert_array_equal(a, b)  # to the last bit


@pytest.mark.parametrize(("sample_pose", "sample_delta"), [(True, False), (False, False), (True, True)])
def test_samplers_get_the_same_density_and_gradient(sample_pose: bool, sample_delta: bool) -> None:
    model = ProbNeRF(PRESETS["tiny"], jax.random.key(0))
    observation = view(37, 20)
    likelihood = Likelihood(Lattice(8), power=0.5, sample_pose=sample_pose, sample_delta=sample_delta)
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    positions = 0.5 * jax.random.normal(jax.random.key(1), (3, likelihood.dim(model)))

    def both(function):
        value, pullback = jax.vjp(lambda q: function(args, q), positions)
        return np.asarray(value), np.asarray(pullback(jnp.array([1.0, -2.0, 0.5]))[0])

    (value, gradient), (expected, slope) = both(log_likelihood), both(plain_log_likelihood)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(gradient, slope, rtol=1e-3, atol=2e-4 * np.abs(slope).max())


def test_without_the_kernel_the_plain_path_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    model, observation = ProbNeRF(PRESETS["tiny"], jax.random.key(0)), view(9, 5)
    likelihood = Likelihood(Lattice(8))
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    positions = jax.random.normal(jax.random.key(1), (2, likelihood.dim(model)))
    monkeypatch.setattr(library, "available", lambda: False)
    monkeypatch.setattr(kernel_call, "call", None)
    np.testing.assert_array_equal(log_likelihood(args, positions), plain_log_likelihood(args, positions))


def exact_density(field, weights, pose, points):
    """Window x density in float64."""
    with jax.enable_x64(True):
        weights, pose, points = (np.asarray(a, np.float64) for a in (weights, pose, points))

        def one(w, p):
            moved = Pose(*p[:5]).to_object(points)
            return field.density(w, moved) * window(moved)

        return np.asarray(jax.jit(jax.vmap(one))(weights, pose))


def scattered(points: int) -> jax.Array:
    """Points in and about the cube: a third of them and more outside the window."""
    return jnp.asarray(np.random.default_rng(points).uniform(-1.3, 1.3, (points, 3)), jnp.float32)


@pytest.mark.parametrize(
    ("name", "particles", "points"),
    [*((name, 3, 1025) for name in FIELDS), ("odd", 1, 1), ("odd", 2, 0), ("odd", 0, 5), ("odd", 1, 2500)],
)
def test_density_is_the_plain_one(name: str, particles: int, points: int) -> None:
    field = FIELDS[name]
    weights, pose = map(jnp.asarray, drawn(field, particles))
    found = np.asarray(kernel_call.density(field, weights, pose, scattered(points)))
    expected = exact_density(field, weights, pose, scattered(points))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max(initial=0.0))
    np.testing.assert_array_equal(found == 0, expected == 0)


def test_neither_threads_nor_the_instruction_set_change_the_density() -> None:
    field = FIELDS["small"]
    weights, pose = map(jnp.asarray, drawn(field, 2))
    call = partial(kernel_call.density, field, weights, pose, scattered(5000))
    for threads in (2, 3, 8):
        np.testing.assert_array_equal(call(threads=threads), call(threads=1))  # to the last bit
    expected = exact_density(field, weights, pose, scattered(5000))
    for isa in ISAS:
        try:
            found = np.asarray(call(isa=isa))
        except jax.errors.JaxRuntimeError as error:
            assert "no instruction set" in str(error) and isa != "plain"
            continue
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())


@pytest.mark.parametrize("what", [np.nan, np.inf])
def test_a_density_of_what_is_no_number_is_none(what: float) -> None:
    weights, pose = drawn(FIELDS["small"], 3)
    weights[0, 7], pose[1, 3] = what, what
    points = scattered(33).at[4, 1].set(what)
    found = np.isfinite(kernel_call.density(FIELDS["small"], jnp.asarray(weights), jnp.asarray(pose), points))
    assert not found[:2].any()
    np.testing.assert_array_equal(found[2], np.arange(33) != 4)


def test_density_of_another_field_or_of_a_plane_is_refused() -> None:
    weights, pose = map(jnp.asarray, drawn(FIELDS["tiny"], 2))
    for field, row, points, said in (
        (FIELDS["odd"], pose, scattered(3), "weights, not"),
        (FIELDS["tiny"], pose[:1], scattered(3), "needs a pose of 6"),
        (FIELDS["tiny"], pose, scattered(3)[:, :2], "3 coordinates"),
    ):
        with pytest.raises(jax.errors.JaxRuntimeError, match=said):
            jax.block_until_ready(kernel_call.density(field, weights, row, points))


@pytest.mark.parametrize("sample_pose", [True, False])
def test_shapes_are_the_same_without_the_kernel(sample_pose: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, observation = ProbNeRF(PRESETS["small"], jax.random.key(0)), view(37, 20)
    likelihood = Likelihood(Lattice(16, 1.1, below=0.15), sample_pose=sample_pose)
    positions = jax.random.normal(jax.random.key(1), (3, likelihood.dim(model)))
    asked = jnp.ones((13, 13, 13), bool)

    def both():
        grids, shares = (jax.jit(lambda *args, f=f: f.__wrapped__(*args)) for f in (opacity_grids, explained))  # anew
        opacity = grids(model, likelihood, positions, observation.pose_sigma, asked)
        return np.asarray(opacity, int), np.asarray(shares(model, likelihood, observation, positions))

    opacity, share = both()
    some = np.random.default_rng(0).random((13, 13, 13)) < 0.3
    found = opacity_grids(model, likelihood, positions, observation.pose_sigma, jnp.asarray(some))
    np.testing.assert_array_equal(found, np.where(some, opacity, 0))
    monkeypatch.setattr(library, "available", lambda: False)
    monkeypatch.setattr(kernel_call, "density", None)
    plain, expected = both()
    assert opacity.max() > 100 and np.abs(opacity - plain).max() <= 1
    np.testing.assert_allclose(share, expected, atol=1.1 / 37)
