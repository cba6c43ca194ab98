"""The posterior network: a normalised density, draws that follow it, any frame, and a file that is its own."""

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from probnerf.prior.checkpoint import Prior, load_posterior_network, save_posterior_network
from probnerf.prior.conditional_densities import ConditionalFlow, YawMixture
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.prior.picture_summary import PictureSummary, harmonics, turned_moments
from probnerf.prior.posterior_flow import NetworkSizes, PictureFeatures, PosteriorNetwork
from tests.probnerf.prior.small_networks import SIGMA, SIZES, picture, shaken

K = SIZES.latent
COUNT = 20_000

_features = eqx.filter_jit(lambda n, p, known: n.features(p, jnp.asarray(SIGMA), known))
_density = eqx.filter_jit(lambda n, f, x: n.log_density(f, x))
_draw = eqx.filter_jit(lambda n, key, f: n.draw_with_density(key, f, COUNT))


@pytest.fixture(scope="module")
def network() -> PosteriorNetwork:
    return shaken()


@pytest.fixture(scope="module", params=[False, True], ids=["pose unknown", "pose known"])
def features(request, network: PosteriorNetwork) -> PictureFeatures:
    return _features(network, picture(), request.param)


def _normal(x: jax.Array, sd: float) -> np.ndarray:
    """Log-density of N(0, sd^2 I)."""
    return np.sum(-0.5 * (np.asarray(x, np.float64) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi), axis=-1)


def _is_one(log_ratio: np.ndarray) -> None:
    """The ratios' mean is 1 within four of its own errors, which are small."""
    ratio = np.exp(np.asarray(log_ratio, np.float64))
    error = ratio.std() / np.sqrt(len(ratio))
    assert error < 0.1 and abs(ratio.mean() - 1.0) < 4 * error, (ratio.mean(), error)


def test_the_density_integrates_to_one_whatever_it_is_drawn_from(network, features):
    """E_p[q / p] = 1 for draws of a wide Gaussian p: nothing here comes from q's own draws."""
    x = 1.4 * jax.random.normal(jax.random.key(3), (COUNT, K + 7 * (not features.known)))
    log_q = np.asarray(_density(network, features, x))
    _is_one(log_q - _normal(x, 1.4))
    assert np.std(log_q - _normal(x, 1.0)) > 0.3  # it is not the prior


def test_draws_follow_the_density(network, features):
    """E_q[p / q] = 1 for narrow Gaussians p at several places; the density told with a draw is the density there."""
    x, log_q = _draw(network, jax.random.key(4), features)
    np.testing.assert_allclose(log_q, _density(network, features, x), atol=2e-4)
    for place in (0.0, 0.4, -0.4):
        _is_one(_normal(x - place, 0.7) - np.asarray(log_q, np.float64))
    if not features.known:  # exactly the prior's laws
        length, rest = np.hypot(x[:, K], x[:, K + 1]), np.asarray(x[:, K + 5 :])
        assert abs(np.mean(length**2) - 2.0) < 0.08
        np.testing.assert_allclose(np.cov(rest.T), np.eye(2), atol=0.06)


@pytest.mark.slow
def test_the_yaw_s_density_integrates_to_one_over_the_circle_and_its_draws_follow_it():
    yaw = YawMixture.of(2.0 * jax.random.normal(jax.random.key(5), (YawMixture.outputs(5),)))
    grid = jnp.linspace(-jnp.pi, jnp.pi, 40_001)
    density = np.exp(np.asarray(yaw.log_density(grid), np.float64))
    assert density[:-1].mean() * 2 * np.pi == pytest.approx(1.0, abs=1e-5)
    assert density[0] == pytest.approx(density[-1], rel=1e-4)
    draws = np.sort(yaw.draw(jax.random.key(6), COUNT))
    cumulative = np.interp(draws, grid, np.cumsum(density) * (grid[1] - grid[0]))
    assert np.abs(cumulative - (np.arange(COUNT) + 0.5) / COUNT).max() < 1.95 / np.sqrt(COUNT)  # Kolmogorov, 0.1%
    # untrained: even
    even = np.asarray(YawMixture.of(jnp.zeros(YawMixture.outputs(16))).log_density(grid))
    assert np.ptp(even) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("dim", [4, 5])
def test_the_flow_s_inverse_undoes_it_and_its_log_determinant_is_autodiff_s(dim: int):
    def build(key):
        leaves, tree = jax.tree.flatten(ConditionalFlow(dim, 3, 16, 4, key))
        return jax.tree.unflatten(tree, [a + 0.3 * jax.random.normal(key, a.shape) for a in leaves])

    with jax.enable_x64(True):
        flow = eqx.filter_jit(build)(jax.random.key(7))
        u = jax.random.normal(jax.random.key(8), (6, dim), jnp.float64)
        condition = jax.random.normal(jax.random.key(9), (6, 3), jnp.float64)
        x, log_det = eqx.filter_jit(flow.forward)(u, condition)
        back, log_inverse = eqx.filter_jit(flow.inverse)(x, condition)
        np.testing.assert_allclose(back, u, atol=1e-9)
        np.testing.assert_allclose(log_inverse, -log_det, atol=1e-9)
        one = eqx.filter_jit(jax.vmap(jax.jacfwd(lambda u, c: flow.forward(u[None], c[None])[0][0])))
        np.testing.assert_allclose(np.linalg.slogdet(one(u, condition))[1], log_det, atol=1e-9)
        assert np.abs(log_det).max() > 0.1


def test_turning_the_frame_turns_the_density(network):
    """A frame whose x axis does not point to the camera: the same picture, each yaw larger by the camera's azimuth."""
    angle = 0.7
    x = np.asarray(jax.random.normal(jax.random.key(2), (50, K + 7)))
    c, s = np.cos(angle), np.sin(angle)
    there = x.copy()
    there[:, K], there[:, K + 1] = c * x[:, K] - s * x[:, K + 1], s * x[:, K] + c * x[:, K + 1]
    here = _density(network, _features(network, picture(), False), x)
    np.testing.assert_allclose(
        _density(network, _features(network, picture(angle), False), jnp.asarray(there)), here, atol=5e-4
    )
    assert np.ptp(np.asarray(here) - np.asarray(_density(network, _features(network, picture(), False), there))) > 0.1


@pytest.mark.slow
def test_the_points_moments_turn_with_the_yaw():
    summary = eqx.filter_jit(lambda key: PictureSummary(8, 2, 8, 1, 3, 2, 16, key))(jax.random.key(0))
    moments = eqx.filter_jit(lambda azimuth_picture: summary.moments(azimuth_picture))
    cosine, sine = harmonics(jnp.cos(jnp.array([0.9])), jnp.sin(jnp.array([0.9])), 3)
    turned = turned_moments(moments(picture()), cosine, sine)
    np.testing.assert_allclose(turned[0], moments(picture(-0.9)).reshape(-1), atol=2e-5)
    assert np.abs(np.asarray(moments(picture()) - moments(picture(-0.9)))).max() > 0.01


def test_a_wrong_picture_or_position_is_refused(network, features):
    with pytest.raises(ValueError, match="the picture has 10 pixels a side; the network wants 8"):
        network.features(picture(size=10), jnp.asarray(SIGMA))
    wanted = K + 7 * (not features.known)
    with pytest.raises(ValueError, match=f"a position has 5 numbers; the posterior network wants {wanted}"):
        network.log_density(features, jnp.zeros((1, 5)))
    with pytest.raises(ValueError, match="a picture of 10 pixels does not divide"):
        PosteriorNetwork(replace(SIZES, image_size=10, patch=4), jax.random.key(0))


@pytest.fixture(scope="module")
def prior() -> Prior:
    model = jax.eval_shape(lambda key: ProbNeRF(replace(PRESETS["tiny"], latent=K), key), jax.random.key(0))
    return Prior(model, {}, "abc")


def test_a_network_survives_its_file_in_half_precision(network, prior, tmp_path: Path):
    path = tmp_path / "n.safetensors"
    save_posterior_network(path, network, prior.hash, {"steps": 3})
    found = load_posterior_network(path, prior)
    assert found.metadata["steps"] == 3 and found.network.sizes == SIZES
    for a, b in zip(jax.tree.leaves(network), jax.tree.leaves(found.network), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)
    x = jax.random.normal(jax.random.key(0), (20, K + 7))
    one, other = (_density(n, _features(n, picture(), False), x) for n in (network, found.network))
    np.testing.assert_allclose(one, other, atol=0.05)
    assert path.stat().st_size < 2 * sum(a.size for a in jax.tree.leaves(network)) + 8_000
    full = jax.eval_shape(lambda key: PosteriorNetwork(NetworkSizes(96), key), jax.random.key(0))
    assert sum(a.size for a in jax.tree.leaves(full)) < 3e6


def test_weights_of_another_architecture_or_prior_are_refused_by_name(network, prior, tmp_path: Path):
    path = tmp_path / "n.safetensors"
    with pytest.raises(FileNotFoundError, match=r"n\.safetensors: no such posterior network"):
        load_posterior_network(path, prior)
    save_posterior_network(path, network, "xyz", {})
    with pytest.raises(ValueError, match=r"n\.safetensors was trained for the prior xyz, not for abc"):
        load_posterior_network(path, prior)
    save_posterior_network(path, network, prior.hash, {"sizes": {"depth": 3}})
    with pytest.raises(ValueError, match=r"sizes of another architecture .*depth"):
        load_posterior_network(path, prior)
    save_posterior_network(path, network, prior.hash, {})
    other = replace(prior, model=jax.eval_shape(lambda key: ProbNeRF(PRESETS["tiny"], key), jax.random.key(0)))
    with pytest.raises(ValueError, match="has 3 latents, the prior has 4"):
        load_posterior_network(path, other)
    arrays = load_file(path)
    save_posterior_network(path, eqx.tree_at(lambda n: n.yaw.bias, network, jnp.zeros(2)), prior.hash, {})
    with pytest.raises(ValueError, match=r"array yaw\.bias is of shape \[2\], this architecture needs \[13\]"):
        load_posterior_network(path, prior)
    save_file(arrays, path)
    with pytest.raises(ValueError, match="has format None, not farside-posterior-network-1"):
        load_posterior_network(path, prior)
    save_file(arrays, path, metadata={"farside": json.dumps({"format": "farside-prior-1"})})
    with pytest.raises(ValueError, match="has format farside-prior-1, not farside-posterior-network-1"):
        load_posterior_network(path, prior)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="is not a readable posterior network"):
        load_posterior_network(path, prior)
    huge = eqx.tree_at(lambda n: n.yaw.bias, network, 1e6 * jnp.ones(13))
    with pytest.raises(ValueError, match=r"array yaw\.bias is not finite in half precision"):
        save_posterior_network(path, huge, prior.hash, {})
