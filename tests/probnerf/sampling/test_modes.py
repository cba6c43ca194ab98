"""Where the sampler begins: Gaussians about the modes, and that the answer is the posterior's all the same."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderModel
from probnerf.geometry import look_at
from probnerf.inference import encoder_guess, infer, likelihood_of, modes_of
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import log_likelihood_one
from probnerf.objects.cylinder_scenes import integrate, scene, total_variation, yaw_histogram
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.prior.posterior_network import EncoderPicture, guesses, potential_at
from probnerf.sampling import modes
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.sampling.modes import log_posterior, mixture_of_modes
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import AdamConfig, InferConfig, ModesConfig, TemperedSMCConfig
from probnerf.types import Pose

NARROW = 1e6  # precision of the narrow mode in each of six dimensions


def two_modes(args, q):
    """A wide mode at -1 along the first axis, a narrow one at +1.5: which holds nine tenths of the posterior."""
    wide = -2.0 * jnp.sum((q - args[0]) ** 2, axis=-1)
    narrow = -0.5 * NARROW * jnp.sum((q - args[1]) ** 2, axis=-1)
    return jnp.logaddexp(wide, narrow + args[2])


def _two_modes():
    """Their arguments; the evidence of both together."""

    def evidence(centre, precision):  # of N(q; 0, I) exp(-precision |q - centre|^2 / 2)
        return -3.0 * np.log1p(precision) - 0.5 * precision / (1 + precision) * centre @ centre

    centres = np.zeros((2, 6))
    centres[:, 0] = -1.0, 1.5
    wide, narrow = evidence(centres[0], 4.0), evidence(centres[1], NARROW)
    height = np.log(9.0) + wide - narrow
    args = (*(jnp.asarray(c, jnp.float32) for c in centres), jnp.float32(height))
    return args, wide + np.log(10.0)


def test_a_narrow_mode_is_lost_from_the_prior_and_kept_from_a_reference_that_knows_it():
    args, evidence = _two_modes()
    config = TemperedSMCConfig(populations=8, particles=48)
    lost = tempered_smc(jax.random.key(0), two_modes, args, 6, config)
    assert float(np.mean(lost.positions[:, 0] > 1.0)) < 0.05
    eye = jnp.eye(6)
    known = GaussianMixture(  # the narrow one off by a deviation, too wide and given too little
        jnp.log(jnp.array([0.1, 0.5, 0.4])),
        jnp.stack([args[1] + 1e-3, args[0], jnp.zeros(6)]),
        jnp.stack([0.7 * np.sqrt(NARROW) * eye, 1.5 * eye, eye]),
    )
    found = tempered_smc(jax.random.key(0), two_modes, args, 6, config, reference=known)
    assert found.result == "converged"
    ratios = np.exp(np.asarray(found.diagnostics.log_evidences, np.float64) - evidence)
    assert abs(ratios.mean() - 1.0) < 4.0 * ratios.std(ddof=1) / np.sqrt(8)
    assert ratios.std(ddof=1) < 0.5
    share = float(np.exp(found.log_weights) @ (np.asarray(found.positions[:, 0]) > 1.0))
    assert share == pytest.approx(0.9, abs=0.06)


def _starts(count: int):
    """Average cylinders at even yaws."""
    yaw = jnp.arange(count) * (2 * jnp.pi / count)
    return jnp.zeros((count, 9)).at[:, 2].set(jnp.cos(yaw)).at[:, 3].set(jnp.sin(yaw))


def test_the_stiffness_is_the_hessian_s_without_its_rising_directions():
    args = scene("seen", True)
    q = jnp.array([[0.3, 0.1, 0.6, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, -0.2, -1.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]])
    along, axes = modes._stiffness(args, q, 1e-2)
    slope = jax.jit(jax.vmap(jax.grad(lambda x: log_likelihood_one(*args, x))))
    offsets = 1e-2 * np.eye(9, dtype=np.float32)
    for k in range(2):
        hessian = np.asarray(slope(q[k][None]) - slope(q[k] + offsets), np.float64) / 1e-2
        expected = np.clip(np.linalg.eigvalsh(0.5 * (hessian + hessian.T)), 0.0, None)
        np.testing.assert_allclose(along[k], expected, rtol=1e-2, atol=1e-3 * expected.max())
        np.testing.assert_allclose(axes[k].T @ axes[k], np.eye(9), atol=1e-5)
    assert float(along.max()) > 100.0 and float(along.min()) == 0.0


def test_of_two_neighbours_the_better_one_climbs_on() -> None:
    args = scene("seen", True)
    still = AdamConfig(steps=1, learning_rate=1e-9, final_learning_rate=1e-9)
    starts = _starts(8)
    mixture = mixture_of_modes(args, starts, ModesConfig(starts=8, screen=still, climb=still))
    value = np.asarray(jax.jit(log_posterior)(args, None, starts)).reshape(4, 2)
    expected = np.asarray(starts).reshape(4, 2, 9)[np.arange(4), value.argmax(axis=1)]
    yaw = [np.arctan2(q[:, 3], q[:, 2]) for q in (np.asarray(mixture.mean[:-1]), expected)]
    assert np.ptp(value, axis=1).min() > 0.1  # not a matter of rounding
    np.testing.assert_allclose(yaw[0], yaw[1], atol=1e-5)


@pytest.mark.slow
def test_gaussians_stand_on_modes_as_wide_as_the_posterior_and_the_prior_is_among_them():
    args = scene("seen", True)
    config = ModesConfig(starts=8, climb=AdamConfig(steps=300), prior_share=0.2)
    starts = _starts(8)
    mixture = mixture_of_modes(args, starts, config)
    assert float(jnp.sum(jnp.exp(mixture.log_weight))) == pytest.approx(1.0, abs=1e-5)
    assert float(jnp.exp(mixture.log_weight[-1])) == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_array_equal(mixture.mean[-1], 0.0)
    np.testing.assert_array_equal(mixture.root[-1], np.eye(9))
    best = int(jnp.argmax(mixture.log_weight[:-1]))
    mean = np.asarray(mixture.mean[best], np.float64)
    yaw = np.degrees(np.arctan2(mean[3], mean[2]))
    assert abs(yaw - 60.0) < 10.0
    at_start = jax.jit(log_posterior)(args, None, starts)
    assert float(log_posterior(args, None, mixture.mean[best][None])[0]) > float(at_start.max())
    grid = integrate(lambda a, q: jax.vmap(lambda one: log_likelihood_one(a[0], a[1], a[2], a[3], one))(q), args)
    spread = np.sqrt(grid.probability @ (grid.cells[:, 0] - grid.probability @ grid.cells[:, 0]) ** 2)
    covariance = np.linalg.inv(np.asarray(mixture.root[best] @ mixture.root[best].T, np.float64))
    across = np.array([-mean[3], mean[2]]) / (mean[2] ** 2 + mean[3] ** 2)  # of yaw by (a, b)
    laplace = np.sqrt(across @ covariance[2:4, 2:4] @ across)
    assert 0.4 * spread < laplace / np.sqrt(config.widen) < 2.5 * spread  # of one-sided differences
    along = np.array([mean[2], mean[3]]) / np.hypot(mean[2], mean[3])
    assert along @ covariance[2:4, 2:4] @ along == pytest.approx(0.66**2, rel=0.15)


@pytest.mark.parametrize(
    ("condition", "depth"),
    [
        ("hidden", True),
        ("half", False),
        ("seen", True),
    ],
)
@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_tempering_from_the_modes_is_the_posterior_by_brute_force(condition, depth):
    args = scene(condition, depth)
    grid = integrate(log_likelihood, args)
    reference = mixture_of_modes(args, _starts(12), ModesConfig())
    histograms = []
    for seed in (0, 1):
        config = TemperedSMCConfig(populations=4)
        posterior = tempered_smc(jax.random.key(seed), log_likelihood, args, 9, config, reference=reference)
        assert posterior.result == "converged"
        assert abs(float(posterior.log_evidence) - grid.log_evidence) <= max(0.5, 3 * float(posterior.log_evidence_se))
        q, w = np.asarray(posterior.positions, np.float64), np.exp(np.asarray(posterior.log_weights))
        histograms.append(yaw_histogram(np.arctan2(q[:, 3], q[:, 2]), w))
    assert np.mean([total_variation(h, grid.histogram()) for h in histograms]) <= 0.1


def _tiny():
    """An untrained model, a picture for its encoder, an observation of the analytic scene."""
    model = ProbNeRF(PRESETS["tiny"], jax.random.key(0))
    size = model.preset.image_size
    T = jnp.asarray(look_at(np.array([4.0, 0.0, 1.5]), np.zeros(3)), jnp.float32)
    picture = EncoderPicture(
        jnp.full((size, size, 3), 0.5), jnp.full((size, size), 4.0), jnp.zeros((size, size)), T, jnp.asarray(0.35)
    )
    return model, picture, scene("hidden", True)[2]


def test_the_modes_of_a_view_are_sought_where_the_encoder_says():
    model, picture, observation = _tiny()
    config = InferConfig(lattice=8, modes=ModesConfig(starts=6, screen=AdamConfig(steps=2), climb=AdamConfig(steps=2)))
    found = modes_of(jax.random.key(1), model, observation, config, picture)
    assert found is not None
    dim = model.latent + 7
    assert found.mean.shape == (4, dim) and np.isfinite(found.root).all() and np.isfinite(found.mean).all()
    # one of each two of six even yaws, hardly climbed
    yaw = np.degrees(np.arctan2(found.mean[:3, model.latent + 1], found.mean[:3, model.latent])) + 180.0
    nearest = np.round(yaw / 60.0)
    np.testing.assert_allclose(yaw, 60.0 * nearest, atol=20.0)
    np.testing.assert_array_equal(np.mod(nearest, 6) // 2, [0, 1, 2])
    posterior, _ = infer(
        jax.random.key(2), model, observation, replace(config, smc=TemperedSMCConfig(particles=8, start_particles=8)),
        reference=found, stages=1,
    )  # fmt: skip
    assert posterior.positions.shape[-1] == dim and np.isfinite(posterior.log_density).all()


def test_guesses_at_a_known_pose_stand_about_the_encoder_s_mean_there():
    model, picture, _ = _tiny()
    found = guesses(jax.random.key(1), model, picture, 5, sample_pose=False)
    assert found.shape == (5, model.latent)
    zero = jnp.zeros(())
    mean, precision = potential_at(model, picture, Pose(zero, zero, zero, zero, zero))
    z, _ = jax.vmap(model.flow.forward)(found)
    assert np.all(np.abs(z - mean) * np.sqrt(precision) < 6.0) and len(np.unique(np.asarray(found), axis=0)) == 5


def test_there_is_nothing_to_begin_at_without_a_picture_an_encoder_enough_to_see_or_room_for_delta():
    model, picture, observation = _tiny()
    config, key = InferConfig(lattice=8), jax.random.key(0)
    assert modes_of(key, model, observation, config, None) is None
    assert modes_of(key, CylinderModel(), observation, config, picture) is None
    assert modes_of(key, model, observation, replace(config, sample_delta=True), picture) is None
    assert modes_of(key, model, observation, replace(config, encoder_starts=False), picture) is None
    hidden = replace(picture, unknown=picture.unknown.at[: len(picture.unknown) // 2].set(1.0))
    assert modes_of(key, model, observation, config, hidden) is None


def test_the_encoder_s_guess_weighs_yaws_by_their_mean_likelihood():
    model, picture, observation = _tiny()
    likelihood = likelihood_of(InferConfig(lattice=8), observation)
    guess = encoder_guess(jax.random.key(0), model, likelihood, observation, picture, yaws=4, draws=3)
    values = np.asarray(guess.log_likelihoods, np.float64).reshape(4, 3)
    each = np.exp(values - values.max()).mean(axis=1)
    weights = np.exp(np.asarray(guess.log_weights, np.float64)).reshape(4, 3)
    np.testing.assert_allclose(weights.sum(axis=1), each / each.sum(), rtol=1e-4)
    np.testing.assert_allclose(weights / weights.sum(axis=1, keepdims=True), 1 / 3, rtol=1e-4)
    assert guess.result == "underway" and float(guess.diagnostics.beta[0]) == 0.0 and np.isnan(guess.log_evidence)
    nowhere = replace(observation, range_sigma=jnp.full_like(observation.range_sigma, np.nan))
    even = encoder_guess(jax.random.key(0), model, likelihood, nowhere, picture, yaws=4, draws=3)
    np.testing.assert_allclose(np.exp(even.log_weights), 1 / 12, rtol=1e-4)


def test_wrong_settings_are_refused():
    odd = dict(starts=3)
    for wrong in (odd, dict(starts=0), dict(prior_share=0.0), dict(widen=0.0), dict(power=2.0), dict(difference=0.0)):
        with pytest.raises(ValueError, match=r"starts .* widen .* power .* prior_share"):
            ModesConfig(**wrong)
    with pytest.raises(ValueError, match="steps 0"):
        AdamConfig(steps=0)
