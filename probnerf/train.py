"""ELBO training of a prior (paper §2.2): views and solid samples of procedural objects in, ProbNeRF weights out.

An object's data are (a) pixels of its views, through the same joint pixel likelihood that inference uses, on a lattice
that is turned, shifted and scaled at random, and (b) solid samples: is a face at this point opaque? They
cost a tenth of a ray, so the first steps use them alone. Both are observations, the objective is an ELBO throughout:
N_rays E[log p] + N_points E[log p] - weight KL. Pixels are drawn by strata (object, near it, elsewhere) and weighted by
each stratum's size, so that the pixel term is an unbiased estimate of its mean over all pixels.

Unlike the paper's, q(z) is not read off pictures: `Recognition` is told the object's exact description, and the decoder
learns several times faster. The picture encoder learns beside it to cover the recognised z (forward KL), so that what a
view leaves open stays open in its answer.
"""

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from probnerf import foam
from probnerf.batches import Batch, draw_batch, solid_points, strata_of
from probnerf.families.tabletop import description, sample_object, sample_objects, signed_distance
from probnerf.model import Likelihood, map_with_gradient, pixel_terms
from probnerf.prior import ProbNeRF, Recognition
from probnerf.types import FREE, OBJECT, Observation, Pose, Rays
from probnerf.views import ViewSet, camera_features, encoder_image


@dataclass(frozen=True)
class TrainConfig:
    """The recipe. Steps count optimiser updates; every number travels with the weights."""

    steps: int = 25_000
    solid_steps: int = 23_000  # of these, the first so many use solid samples alone
    batch: int = 32  # objects per step in the solid phase
    ray_batch: int = 8  # objects per step afterwards
    encode_objects: int = 8  # of a batch, those whose views the encoder sees
    views: int = 3  # encoder views per object; a random number of them is used
    object_rays: int = 96
    near_rays: int = 48  # free pixels within 2 pixels of the object
    far_rays: int = 16
    points: int = 1024  # solid samples per object (see `solid_points`)
    effective_rays: float = 1500.0  # N_rays: independent residuals per object
    effective_points: float = 3000.0  # N_points
    learning_rate: float = 2e-3
    final_learning_rate: float = 2e-5
    warmup: int = 500
    kl_warmup: int = 8_000
    average: float = 0.999  # decay of the averaged weights, which are what is shipped
    seed: int = 0
    checkpoint_every: int = 500
    log_every: int = 50
    map_batch: int | None = None  # objects per vectorised chunk of the field (None: one by one, best on a CPU)


def encode(model: ProbNeRF, batch: Batch) -> tuple[Float[Array, "b k"], Float[Array, "b k"]]:
    """Mean and precision of q(z | views) per object."""

    def one(rgb, distance, unknown, used, T, tangent):
        images = jax.vmap(encoder_image)(rgb / 255.0, distance, unknown.astype(jnp.float32), T, tangent)
        return model.encoder(images, jax.vmap(camera_features)(T, tangent), used)

    return jax.vmap(one)(
        batch.rgb, batch.distance, batch.unknown, batch.used, batch.T_object_camera, batch.tan_half_fov
    )


def kl_estimate(model: ProbNeRF, z: Array, mean: Array, precision: Array) -> Float[Array, ""]:
    """log q(z | views) - log N(m^-1(z); 0, I) |dm^-1/dz| at one draw z (paper, eq. of the ELBO)."""
    z_tilde, log_det = model.flow.inverse(z)
    log_q = 0.5 * jnp.sum(jnp.log(precision) - precision * (z - mean) ** 2)
    return log_q - (log_det - 0.5 * jnp.sum(z_tilde**2))


def encoder_loss(model: ProbNeRF, batch: Batch, z: Float[Array, "b k"], objects: int) -> Float[Array, ""]:
    """-log q(z | views) of the recognised z: the encoder learns to cover what views leave open, not to pick a mode."""
    few = jax.tree.map(lambda a: a[:objects], batch)
    mean, precision = encode(model, few)
    z = jax.lax.stop_gradient(z[:objects])
    return -0.5 * jnp.mean(jnp.sum(jnp.log(precision) - precision * (z - mean) ** 2, axis=-1))


class _PerObject(eqx.Module):
    """What the field terms of one object need."""

    points: Array
    solid: Array
    origin: Array
    direction: Array
    ray_rgb: Array
    ray_range: Array
    ray_weight: Array
    turn: Array


def _solid_terms(shared: tuple, item: _PerObject, weights: Array) -> Float[Array, ""]:
    """Mean log-likelihood of solid samples and of surface colours (first phase)."""
    model_field, likelihood, config, colour_weight = shared
    tau = model_field.density(weights, item.points) / likelihood.lattice.cubes
    opaque = -jnp.expm1(-tau)
    eps = likelihood.mask_error
    probability = jnp.where(item.solid, opaque, 1.0 - opaque)
    solid = jnp.mean(jnp.log(eps + (1.0 - 2.0 * eps) * probability))
    if not colour_weight:
        return config.effective_points * solid
    n = config.object_rays
    surface = item.origin[:n] + (item.ray_range[:n, None] + 0.01) * item.direction[:n]
    sigma = jax.lax.stop_gradient(model_field.density(weights, surface))
    rgb = model_field.colour(weights, surface, item.direction[:n], sigma)
    colour = -0.5 * jnp.mean(jnp.sum((rgb - item.ray_rgb[:n]) ** 2, -1)) / likelihood.colour_sigma**2
    return config.effective_points * solid + config.effective_rays * colour_weight * colour


def _ray_terms(shared: tuple, item: _PerObject, weights: Array) -> Float[Array, ""]:
    """Weighted mean of the joint pixel log-likelihood over a lattice that is turned, shifted and scaled."""
    model_field, likelihood, config, _ = shared
    pose = Pose(yaw=item.turn[0], x=item.turn[1], y=item.turn[2], log_scale=item.turn[3])
    scale = jnp.exp(pose.log_scale)
    rays = Rays(origin=_to_view(pose, item.origin), direction=_turn(pose, item.direction))
    n = config.object_rays
    count = item.ray_range.shape[0]
    observation = Observation(
        rays=rays,
        status=jnp.where(jnp.arange(count) < n, OBJECT, FREE),
        rgb=item.ray_rgb,
        rgb_valid=jnp.ones(count, bool),
        range=item.ray_range * scale,
        range_sigma=jnp.full((count,), 0.01),
        range_valid=item.ray_range > 0,
        limit=jnp.full((count,), 0.5 * foam.FAR),
        pose_sigma=jnp.zeros(3),
        colour_count=n,
    )
    t = foam.crossings(rays, likelihood.lattice)
    terms = pixel_terms(model_field, weights, pose, likelihood, observation, t)
    return config.effective_rays * jnp.sum(item.ray_weight * terms) + _solid_terms(
        (model_field, likelihood, config, 0.0), item, weights
    )


def _turn(pose: Pose, d: Array) -> Array:
    c, s = jnp.cos(pose.yaw), jnp.sin(pose.yaw)
    return jnp.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]], axis=-1)


def _to_view(pose: Pose, p: Array) -> Array:
    """Canonical points in the view frame: the inverse of Pose.to_object."""
    base = jnp.array([0.0, 0.0, foam.BASE_Z])
    return jnp.exp(pose.log_scale) * _turn(pose, p - base) + base + jnp.stack([pose.x, pose.y, jnp.zeros(())])


def loss(
    networks: tuple[ProbNeRF, Recognition],
    batch: Batch,
    key: Array,
    kl_weight: Array,
    likelihood: Likelihood,
    config: TrainConfig,
    rays: bool,
) -> tuple[Array, dict[str, Array]]:
    """Negative ELBO per object, with q(z) by recognition, plus the picture encoder's loss; and the parts."""
    model, recognition = networks
    k0, k1 = jax.random.split(key)
    mean, precision = jax.vmap(lambda o: recognition(description(o)))(batch.objects)
    z = mean + jax.random.normal(k0, mean.shape) / jnp.sqrt(precision)
    kl = jnp.mean(jax.vmap(kl_estimate, in_axes=(None, 0, 0, 0))(model, z, mean, precision))
    weights = jax.vmap(model.hyper)(z)
    points = solid_points(batch, k1, config.points)
    solid = jax.vmap(signed_distance)(batch.objects, points) <= 0.0
    drawn = (batch.origin, batch.direction, batch.ray_rgb, batch.ray_range, batch.ray_weight, batch.turn)
    each = _PerObject(points, solid, *map(jnp.asarray, drawn))
    terms = _ray_terms if rays else _solid_terms
    fit = jnp.mean(
        map_with_gradient(_Bound(terms, (model.field, likelihood, config, 0.3)), config.map_batch, None, each, weights)
    )
    encoder = encoder_loss(model, batch, z, min(config.encode_objects, z.shape[0]))
    return kl_weight * kl - fit + encoder, {"fit": fit, "kl": kl, "encoder": encoder}


@dataclass(frozen=True)
class _Bound:
    """A function with its constants: hashable, as a static argument must be."""

    terms: Callable
    constants: tuple

    def __call__(self, _: Any, item: _PerObject, weights: Array) -> Array:
        return self.terms(self.constants, item, weights)


class TrainState(eqx.Module):
    """Everything that a resumed run needs; batches and keys are functions of the step."""

    model: ProbNeRF
    recognition: Recognition
    average: ProbNeRF
    optimiser: optax.OptState
    step: Array


def optimiser_of(config: TrainConfig) -> optax.GradientTransformation:
    """Adam (paper §2.2) with warm-up, cosine decay and clipping against the rare bad batch."""
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, min(config.warmup, config.steps // 4), config.steps, config.final_learning_rate
    )
    return optax.chain(optax.clip_by_global_norm(200.0), optax.adam(schedule))


def initial_state(model: ProbNeRF, config: TrainConfig) -> TrainState:
    """A fresh run."""
    average = jax.tree.map(jnp.copy, model)  # its own buffers: a step gives its inputs away
    size = description(sample_object(0)).shape[0]
    key = jax.random.fold_in(jax.random.key(config.seed), 1)
    recognition = Recognition(size, model.latent, model.preset.hyper_hidden, key)
    optimiser = optimiser_of(config).init((model, recognition))
    return TrainState(model, recognition, average, optimiser, jnp.zeros((), jnp.int32))


@eqx.filter_jit(donate="all-except-first")
def train_step(
    static: tuple[Likelihood, TrainConfig, bool], state: TrainState, batch: Batch
) -> tuple[TrainState, dict[str, Array]]:
    """One update."""
    likelihood, config, rays = static
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    kl_weight = jnp.clip(state.step / config.kl_warmup, 0.02, 1.0)
    (value, parts), gradient = jax.value_and_grad(loss, has_aux=True)(
        (state.model, state.recognition), batch, key, kl_weight, likelihood, config, rays
    )
    update, optimiser = optimiser_of(config).update(gradient, state.optimiser)
    model, recognition = optax.apply_updates((state.model, state.recognition), update)
    decay = jnp.minimum(config.average, (1.0 + state.step) / (10.0 + state.step))
    average = jax.tree.map(lambda a, b: decay * a + (1.0 - decay) * b, state.average, model)
    return TrainState(model, recognition, average, optimiser, state.step + 1), {"loss": value, **parts}


def save_checkpoint(path: Path, state: TrainState) -> None:
    """Atomic: a killed run leaves the old checkpoint or the new one, never half of one."""
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        eqx.tree_serialise_leaves(file, state)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def train(
    model: ProbNeRF, views: ViewSet, likelihood: Likelihood, config: TrainConfig, folder: Path
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Run or resume in `folder`; yields (state, metrics) every `log_every` steps and appends them to history.jsonl.

    Raises FloatingPointError on a non-finite loss, naming the step; the last checkpoint stays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, history = folder / "checkpoint.eqx", folder / "history.jsonl"
    state = initial_state(model, config)
    settings = folder / "config.json"
    described = json.dumps(asdict(config), indent=1)
    if checkpoint.exists():
        if settings.exists() and settings.read_text() != described:
            raise ValueError(f"{folder} holds a run of another recipe: see {settings}, or give a fresh --out")
        state = eqx.tree_deserialise_leaves(checkpoint, state)
        lines = history.read_text().splitlines() if history.exists() else []
        kept = [line for line in lines if json.loads(line)["step"] <= int(state.step)]
        history.write_text("".join(line + "\n" for line in kept))
    settings.write_text(described)
    objects = sample_objects([int(s) for s in views.seeds])
    strata = strata_of(views)
    start = int(state.step)

    def batch_of(step: int) -> Batch:
        size = config.ray_batch if step >= config.solid_steps else config.batch
        return draw_batch(views, objects, strata, config, step, size)

    with ThreadPoolExecutor(1) as drawer:  # the next batch is drawn while this one is used
        coming = drawer.submit(batch_of, start)
        for step in range(start, config.steps):
            batch = coming.result()
            coming = drawer.submit(batch_of, step + 1)
            state, parts = train_step((likelihood, config, step >= config.solid_steps), state, batch)
            done = step + 1
            if done % config.log_every == 0 or done == config.steps:
                metrics = {k: float(v) for k, v in parts.items()}
                if not np.isfinite(metrics["loss"]):
                    raise FloatingPointError(
                        f"loss is {metrics['loss']} at step {done}; {checkpoint} holds an earlier step"
                    )
                with open(history, "a") as file:
                    file.write(json.dumps({"step": done, "rays": step >= config.solid_steps, **metrics}) + "\n")
                if done % config.checkpoint_every == 0 or done == config.steps:
                    save_checkpoint(checkpoint, state)
                yield state, {"step": done, **metrics}
