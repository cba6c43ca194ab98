"""Training of the posterior network: -log q(z~, yaw, x, y, log-scale, kind | picture) averaged over simulated pictures.

This is the forward Kullback-Leibler divergence to the exact posterior, up to a constant (neural posterior estimation;
Papamakarios and Murray, 2016). At its minimum the network is calibrated for the world that the pictures come from.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.prior.networks import RealNVP
from probnerf.prior.posterior_flow import PosteriorNetwork
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.training.picture_set import Examples, PictureSet, changed, split
from probnerf.training.run_folder import RunFolder
from probnerf.training.settings import PosteriorTrainConfig
from probnerf.types import KINDS


class PosteriorTrainState(eqx.Module):
    """All state that a resumed run needs. Examples and keys depend only on the step and the seed."""

    network: PosteriorNetwork
    average: PosteriorNetwork  # moving average of the weights: what is used afterwards
    optimiser: optax.OptState
    step: Array


def optimiser_of(config: PosteriorTrainConfig) -> optax.GradientTransformation:
    """Adam with warm-up, cosine decay and gradient clipping."""
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, min(config.warmup, config.steps // 4), config.steps, config.final_learning_rate
    )
    return optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(schedule))


def initial_state(network: PosteriorNetwork, config: PosteriorTrainConfig) -> PosteriorTrainState:
    """The state of a new run. It has its own copies of the weights, because a step donates its input buffers."""
    first, second = (jax.tree.map(jnp.copy, network) for _ in range(2))
    return PosteriorTrainState(first, second, optimiser_of(config).init(first), jnp.zeros((), jnp.int32))


def log_densities(
    network: PosteriorNetwork, examples: Examples, z_tilde: Float[Array, "b k"]
) -> tuple[Float[Array, "b"], Float[Array, "b"], Float[Array, "b"], Float[Array, "b"]]:
    """log q of yaw, of (x, y, log-scale), of z~ and of the kind for each example.

    The first two are 0 where the pose is given, the last where the kind is untold (`len(KINDS)` or more).
    """

    def one(picture: EncoderPicture, sigma, given, yaw, pose, z, kind):
        features = network.features(picture, sigma, given=given)
        parts = network.log_density_parts(features, yaw[None], pose[None], z[None])
        told = features.log_kinds[jnp.minimum(kind, len(KINDS) - 1)]
        return *(part[0] for part in parts), jnp.where(kind < len(KINDS), told, 0.0)

    seen = _as_floats(examples.picture)
    told = (examples.pose_sigma, examples.known, examples.yaw, examples.pose, z_tilde, examples.kind)
    yaw, pose, shape, kind = jax.vmap(one)(seen, *told)
    return (1.0 - examples.known) * yaw, (1.0 - examples.known) * pose, shape, kind


@eqx.filter_jit
def log_kinds(network: PosteriorNetwork, examples: Examples) -> Float[Array, "b kinds"]:
    """Logarithms of the probabilities of `KINDS` for each example."""

    def one(picture: EncoderPicture, sigma, given):
        return network.features(picture, sigma, given=given).log_kinds

    return jax.vmap(one)(_as_floats(examples.picture), examples.pose_sigma, examples.known)


def _as_floats(seen: EncoderPicture) -> EncoderPicture:
    return replace(
        seen,
        rgb=seen.rgb / 255.0,
        distance=seen.distance.astype(jnp.float32),
        unknown=seen.unknown.astype(jnp.float32),
    )


def loss(
    network: PosteriorNetwork, examples: Examples, key: PRNGKeyArray, prior: RealNVP | None = None
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean of -log q at a draw of each example's latents, nats, and its parts.

    With `prior`, mean and sd tell z = m(z~), and its inverse makes z~ of each draw.
    """
    z = examples.mean + examples.sd * jax.random.normal(key, examples.mean.shape)
    z_tilde = z if prior is None else jax.lax.stop_gradient(jax.vmap(lambda one: prior.inverse(one)[0])(z))
    yaw, pose, shape, kind = (-jnp.mean(part) for part in log_densities(network, examples, z_tilde))
    return yaw + pose + shape + kind, {"yaw": yaw, "pose": pose, "shape": shape, "kind": kind}


def updated(
    fixed: tuple[PosteriorTrainConfig, RealNVP | None], state: PosteriorTrainState, examples: Examples
) -> tuple[PosteriorTrainState, dict[str, Array]]:
    """One update."""
    config, prior = fixed
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    (value, parts), gradient = jax.value_and_grad(loss, has_aux=True)(state.network, examples, key, prior)
    update, optimiser = optimiser_of(config).update(gradient, state.optimiser)
    network = optax.apply_updates(state.network, update)
    # early on, a shorter memory: the first weights are poor
    decay = jnp.minimum(config.average, (1.0 + state.step) / (10.0 + state.step))
    average = jax.tree.map(lambda a, b: decay * a + (1.0 - decay) * b, state.average, network)
    return PosteriorTrainState(network, average, optimiser, state.step + 1), {"loss": value, **parts}


train_step = eqx.filter_jit(updated, donate="all-except-first")


@eqx.filter_jit
def _validation_step(
    network: PosteriorNetwork, examples: Examples, key: PRNGKeyArray, prior: RealNVP | None
) -> dict[str, Array]:
    value, parts = loss(network, examples, key, prior)
    return {"loss": value, **parts}


def validate(
    network: PosteriorNetwork,
    pictures: PictureSet,
    rows: np.ndarray,
    config: PosteriorTrainConfig,
    prior: RealNVP | None = None,
) -> dict[str, float]:
    """The mean loss and its parts over held-out rows, with the same changes and draws each time; empty without rows."""
    rng = np.random.default_rng([config.seed, 2])
    rows = rng.permutation(rows)[: config.validation_pictures]
    batch = min(config.batch, len(rows))
    parts = []
    for i in range(len(rows) // batch if batch else 0):
        examples = changed(pictures, rows[i * batch : (i + 1) * batch], rng, config)
        parts.append(_validation_step(network, examples, jax.random.key(i), prior))
    return {f"validation_{name}": float(np.mean([p[name] for p in parts])) for name in (parts[0] if parts else ())}


def train(
    network: PosteriorNetwork,
    pictures: PictureSet,
    config: PosteriorTrainConfig,
    folder: Path,
    prior: RealNVP | None = None,
) -> Iterator[tuple[PosteriorTrainState, dict[str, float]]]:
    """Run or resume in `folder`; yields (state, metrics) every `log_every` steps and appends them to history.jsonl.

    `prior` is the model's flow if the pictures tell z instead of z~. Raises ValueError if there is nothing to train on,
    and FloatingPointError with the step if the loss is not finite. The last checkpoint is kept.
    """
    size, latent = pictures.rgb.shape[1], pictures.mean.shape[1]
    if (size, latent) != (network.sizes.image_size, network.sizes.latent):
        raise ValueError(
            f"the pictures have {size} pixels a side and {latent} latents; "
            f"the network wants {network.sizes.image_size} and {network.sizes.latent}"
        )
    rows, held = split(pictures, config)
    if not len(rows):
        raise ValueError("no picture is left to train on; give more objects or a smaller share for validation")
    run = RunFolder(folder, config)
    state = run.resume(initial_state(network, config))
    start = int(state.step)

    def data_of(step: int) -> Examples:
        rng = np.random.default_rng([config.seed, step, 3])
        return changed(pictures, rng.choice(rows, config.batch), rng, config)

    with ThreadPoolExecutor(1) as drawer:  # the next batch is drawn while this one is used
        coming = drawer.submit(data_of, start)
        for step in range(start, config.steps):
            examples = coming.result()
            coming = drawer.submit(data_of, step + 1)
            state, parts = train_step((config, prior), state, examples)
            done = step + 1
            if done % config.log_every == 0 or done == config.steps:
                metrics = {name: float(value) for name, value in parts.items()}
                if not np.isfinite(metrics["loss"]):
                    raise FloatingPointError(
                        f"loss is {metrics['loss']} at step {done}; {run.checkpoint} holds an earlier step"
                    )
                if done % config.validate_every == 0 or done == config.steps:
                    metrics |= validate(state.average, pictures, held, config, prior)
                run.record({"step": done, **metrics})
                if done % config.checkpoint_every == 0 or done == config.steps:
                    run.save(state)
                yield state, {"step": done, **metrics}
