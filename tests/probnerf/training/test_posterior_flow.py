"""Training of the posterior network, in a world whose exact posterior is known.

A picture shows, as colours, with noise: the first two latents turned by the yaw; the direction of twice the yaw (so two
opposite yaws fit equally well); and x. The third latent, y and the scale are not seen. The kind is the sign of x.
"""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from probnerf.prior.networks import RealNVP
from probnerf.prior.posterior_flow import PosteriorNetwork
from probnerf.training.picture_set import PictureSet, changed
from probnerf.training.posterior_flow import PosteriorTrainState, log_densities, loss, train
from probnerf.training.settings import PosteriorTrainConfig
from tests.probnerf.prior.small_networks import SIGMA, SIZES, picture, shaken

NOISE, YAW_NOISE = 0.5, 0.6  # of latents and x; of the direction
CONFIG = PosteriorTrainConfig(
    steps=6, batch=8, warmup=2, validate_every=2, log_every=1, checkpoint_every=2, validation=0.2
)


def _turned(yaw: np.ndarray, v: np.ndarray) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)


def toy(count: int, seed: int) -> tuple[PictureSet, np.ndarray]:
    """Pictures with their latents, and what they show [count, 5]."""
    rng, one = np.random.default_rng(seed), picture()
    z, pose, yaw = rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), rng.uniform(-np.pi, np.pi, count)
    direction = np.stack([np.cos(2 * yaw), np.sin(2 * yaw)], axis=1)
    clean = np.concatenate([_turned(yaw, z[:, :2]), direction, pose[:, :1]], axis=1)
    shown = clean + rng.normal(size=(count, 5)) * [NOISE, NOISE, YAW_NOISE, YAW_NOISE, NOISE]
    colours = np.zeros((count, 2, 3))
    colours.reshape(count, -1)[:, :5] = shown
    rgb = np.repeat(np.clip(0.5 + 0.1 * colours, 0.0, 1.0), 4, axis=1)[:, :, None].repeat(8, axis=2)

    def repeated(a) -> np.ndarray:
        return np.stack([np.asarray(a)] * count).astype(np.float32)

    pictures = PictureSet(
        rgb=np.round(255 * rgb).astype(np.uint8),
        distance=np.full((count, 8, 8), -1.0, np.float16),
        unknown=np.zeros((count, 8, 8), np.uint8),
        T_view_camera=repeated(one.T_view_camera),
        tan_half_fov=repeated(one.tan_half_fov),
        pose_sigma=repeated(SIGMA),
        yaw=yaw.astype(np.float32),
        pose=pose.astype(np.float32),
        mean=z.astype(np.float32),
        sd=np.zeros((count, 3), np.float32),
        object_id=np.arange(count),
        kind=(pose[:, 0] > 0.0).astype(np.uint8),
    )
    return pictures, shown


def exact(pictures: PictureSet, shown: np.ndarray) -> tuple[np.ndarray, ...]:
    """Logarithms of the exact posterior of yaw, of (x, y, scale), of z~ and of the kind, at each picture's latents."""
    gain = 1.0 / (1.0 + NOISE**2)
    sd = np.sqrt(NOISE**2 * gain)
    kappa = np.hypot(shown[:, 2], shown[:, 3]) / YAW_NOISE**2
    apart = 2 * pictures.yaw - np.arctan2(shown[:, 3], shown[:, 2])
    yaw = kappa * (np.cos(apart) - 1.0) - np.log(2 * np.pi * special.i0e(kappa))
    pose = stats.norm.logpdf(pictures.pose[:, 0], gain * shown[:, 4], sd)
    pose += stats.norm.logpdf(pictures.pose[:, 1:3]).sum(axis=1)
    z = stats.norm.logpdf(pictures.mean[:, :2], gain * _turned(-pictures.yaw, shown[:, :2]), sd).sum(axis=1)
    kind = stats.norm.logcdf((2.0 * pictures.kind - 1.0) * gain * shown[:, 4] / sd)
    return yaw, pose, z + stats.norm.logpdf(pictures.mean[:, 2]), kind


@pytest.mark.nightly
def test_a_trained_network_is_the_exact_posterior(tmp_path: Path) -> None:
    """The divergence from the exact posterior is small in each part, and ranks of the truth among draws are uniform."""
    sizes = replace(SIZES, channels=32, context=64, trunk=64, condition=32, couplings=4, hidden=64, yaw_components=8)
    config = PosteriorTrainConfig(
        steps=5_000, batch=256, learning_rate=3e-3, warmup=200, without_depth=0.0, known_pose=0.0, occluded=0.0,
        validate_every=1_000, log_every=1_000, checkpoint_every=5_000, average=0.998,
    )  # fmt: skip
    network = eqx.filter_jit(PosteriorNetwork)(sizes, jax.random.key(0))
    *_, (state, metrics) = train(network, toy(100_000, 0)[0], config, tmp_path)
    assert metrics["validation_loss"] < metrics["loss"] + 0.5

    count, draws = 2_000, 63
    pictures, shown = toy(count, 1)
    plain = changed(pictures, np.arange(count), np.random.default_rng(0), config)
    examples = jax.device_put(plain)
    found = eqx.filter_jit(log_densities)(state.average, examples, examples.mean)
    for name, p, q in zip(("yaw", "pose", "z", "kind"), exact(pictures, shown), found, strict=True):
        divergence = p - np.asarray(q, np.float64)
        print(name, divergence.mean(), divergence.std() / np.sqrt(count))
        assert -0.02 < divergence.mean() < 0.03, name

    @eqx.filter_jit
    def drawn(network, picture, sigma, key):
        seen = replace(picture, rgb=picture.rgb / 255.0, distance=picture.distance.astype(jnp.float32))
        return network.draw(key, network.features(seen, sigma), draws)

    keys = jax.random.split(jax.random.key(5), count)
    x = np.asarray(jax.vmap(drawn, in_axes=(None, 0, 0, 0))(state.average, examples.picture, examples.pose_sigma, keys))
    yaw = np.arctan2(x[..., 4], x[..., 3])
    statistics = {
        "z0": (x[..., 0], pictures.mean[:, 0]),
        "z2": (x[..., 2], pictures.mean[:, 2]),
        "x": (x[..., 5], pictures.pose[:, 0]),
        "yaw": (np.cos(yaw), np.cos(pictures.yaw)),
        "twice the yaw": (np.cos(2 * yaw), np.cos(2 * pictures.yaw)),
        "z along the yaw": (x[..., 0] * np.cos(yaw), pictures.mean[:, 0] * np.cos(pictures.yaw)),
    }
    for name, (among, truth) in statistics.items():
        ranks = np.sum(among < truth[:, None], axis=1)
        counts = np.bincount(ranks * 8 // (draws + 1), minlength=8)
        print(name, counts, stats.chisquare(counts).pvalue)
        assert stats.chisquare(counts).pvalue > 1e-3, (name, counts)


def run(folder: Path, steps: int | None = None, config: PosteriorTrainConfig = CONFIG) -> PosteriorTrainState:
    *_, (state, _) = islice(train(shaken(), toy(60, 0)[0], config, folder), steps)
    return state


@pytest.mark.slow
def test_a_killed_run_resumes_with_identical_results(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    run(tmp_path / "killed", steps=5)  # the last checkpoint is of step 4: step 5 is lost
    resumed = run(tmp_path / "killed")
    assert int(resumed.step) == CONFIG.steps
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    lines = (tmp_path / "killed" / "history.jsonl").read_text().splitlines()
    assert lines == (tmp_path / "whole" / "history.jsonl").read_text().splitlines()
    assert [("validation_loss" in json.loads(line)) for line in lines] == [False, True] * 3
    moved = [np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (whole.network, whole.average)), strict=True)]
    assert max(moved) > 0.0
    with pytest.raises(ValueError, match="another recipe"):
        run(tmp_path / "killed", config=replace(CONFIG, learning_rate=1.0))


@pytest.mark.slow
def test_a_given_pose_leaves_only_the_shape(tmp_path: Path) -> None:
    """And pictures that tell z teach z~ = m^-1(z)."""
    config = replace(CONFIG, known_pose=1.0)
    examples = jax.device_put(changed(toy(8, 0)[0], np.arange(8), np.random.default_rng(0), config))
    network = shaken()
    value, parts = eqx.filter_jit(loss)(network, examples, jax.random.key(0))
    assert (
        parts["yaw"] == 0.0 and parts["pose"] == 0.0 and float(value) == pytest.approx(parts["shape"] + parts["kind"])
    )
    flow = RealNVP(3, 4, jax.random.key(0))  # untrained: it permutes
    told = eqx.tree_at(lambda e: e.mean, examples, jax.vmap(lambda z: flow.forward(z)[0])(examples.mean))
    assert float(eqx.filter_jit(loss)(network, told, jax.random.key(0), flow)[0]) == pytest.approx(
        float(value), rel=1e-5
    )


@pytest.mark.slow
def test_a_loss_that_is_no_number_is_named_with_its_step(tmp_path: Path) -> None:
    broken = eqx.tree_at(lambda n: n.yaw.bias, shaken(), jnp.full(13, jnp.nan))
    with pytest.raises(FloatingPointError, match="loss is nan at step 1"):
        next(train(broken, toy(20, 0)[0], CONFIG, tmp_path))


def test_pictures_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    pictures = toy(20, 0)[0]
    with pytest.raises(ValueError, match="8 pixels a side and 3 latents; the network wants 8 and 5"):
        other = jax.eval_shape(lambda key: PosteriorNetwork(replace(SIZES, latent=5), key), jax.random.key(0))
        next(train(other, pictures, CONFIG, tmp_path / "b"))
    with pytest.raises(ValueError, match="no picture is left to train on"):
        next(train(shaken(), pictures, replace(CONFIG, validation=1.0), tmp_path / "c"))
