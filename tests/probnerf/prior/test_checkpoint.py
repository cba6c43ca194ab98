"""A prior is read with the posterior network beside it, and refuses another prior's."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from probnerf.prior.checkpoint import load_prior, network_path, save_posterior_network, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.probnerf.prior.small_networks import SIZES, shaken

TINY = PRESETS["tiny"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    shapes = jax.eval_shape(lambda key: ProbNeRF(TINY, key), jax.random.key(0))
    path = tmp_path / "p.safetensors"
    save_prior(path, jax.tree.map(lambda a: 0.0 * jax.numpy.ones(a.shape, a.dtype), shapes), {})
    return path


def test_a_prior_has_a_network_where_the_file_is_beside_it(path: Path) -> None:
    alone = load_prior(path)
    assert alone.network is None and alone.identity == alone.hash
    beside = network_path(path)
    assert beside == path.parent / "p.network.safetensors"
    save_posterior_network(beside, shaken(replace(SIZES, latent=TINY.latent)), alone.hash, {})
    both = load_prior(path)
    assert both.network is not None and both.network.sizes.latent == TINY.latent
    assert both.hash == alone.hash and both.identity == f"{alone.hash}+{both.network_hash}" and both.network_hash


def test_a_network_of_another_prior_is_refused_by_name(path: Path) -> None:
    save_posterior_network(network_path(path), shaken(replace(SIZES, latent=TINY.latent)), "another", {})
    with pytest.raises(ValueError, match=r"p\.network\.safetensors was trained for the prior another, not for \w{16}"):
        load_prior(path)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda a: a.at[..., 0].set(jnp.nan), "not finite"),
        (lambda a: a + jnp.inf, "not finite"),
        (lambda a: a.astype(jnp.int32), "of int32"),
        (lambda a: a > 0, "of bool"),
    ],
)
def test_weights_that_are_no_finite_floats_are_refused(path: Path, spoil: Callable, why: str) -> None:
    save_prior(path, jax.tree.map(lambda a: spoil(a) if a.ndim == 2 else a, load_prior(path).model), {})
    with pytest.raises(ValueError, match=rf"array \S+ is {why}"):
        load_prior(path)


def test_a_file_that_is_too_large_for_weights_is_refused_unread(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(1 << 34)
    with pytest.raises(ValueError, match="has 16384 MB, more than any"):
        load_prior(path)
