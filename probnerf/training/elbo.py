"""ELBO training of a prior (paper §2.2): procedural objects in, ProbNeRF weights out. Two phases.

Solid phase: the data are occupancy and surface colour at points (`solids`), also at points of other objects. It needs
no pictures and costs a tenth of the ray phase. It trains the decoder. Ray phase: the data also include pixels of views.
Their likelihood is the joint pixel likelihood of inference, on a lattice that is rotated, shifted and scaled at random.
This phase also trains the picture encoder. The objective is an ELBO in both phases: N_points E[log p] + N_colours E[log
p] + N_rays E[log p] - weight KL. Pixels are drawn by strata (object, near it, elsewhere) and weighted by each stratum's
size. So the pixel term is an unbiased estimate of its mean over all pixels.

In the paper, q(z) comes from pictures. Here it comes from `Recognition`, whose input is the object's exact description,
and the decoder learns several times faster. The picture encoder learns to cover the recognised z (forward KL), so its
density stays wide where a view is ambiguous. Without `solids` (None), training follows the paper: every step uses rays,
and q(z) comes from the picture encoder.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float

from probnerf.likelihood.dispatch import map_with_gradient, weighted_terms
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import FREE, OBJECT
from probnerf.prior.encoder_input import camera_features, encoder_image
from probnerf.prior.networks import ProbNeRF, Recognition
from probnerf.rendering import foam
from probnerf.training.batches import Batch, draw_batch, strata_of
from probnerf.training.pictures import ViewSet
from probnerf.training.processes import everywhere, is_first, share_by_share, shares
from probnerf.training.run_folder import RunFolder
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import DESCRIPTION, ShapeBatch, ShapeSet, batch_of, draw_shapes, points_of_others
from probnerf.training.solid_terms import colour_samples, solid_terms
from probnerf.types import Observation, Pose, Rays


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


def encoder_loss(model: ProbNeRF, batch: Batch, z: Float[Array, "b k"]) -> Float[Array, ""]:
    """-log q(z | views) at the recognised z. So the encoder learns to cover all shapes that fit, not to pick a mode."""
    mean, precision = encode(model, batch)
    z = jax.lax.stop_gradient(z)
    return -0.5 * jnp.mean(jnp.sum(jnp.log(precision) - precision * (z - mean) ** 2, axis=-1))


class _ObjectRays(eqx.Module):
    """One object's rays."""

    origin: Array
    direction: Array
    rgb: Array
    range: Array
    weight: Array
    turn: Array


def _ray_terms(shared: tuple, item: tuple[_ObjectRays, tuple | None], weights: Array) -> Float[Array, ""]:
    """Weighted mean of the joint pixel log-likelihood on a rotated, shifted and scaled lattice, plus the solid terms.

    The object's rays come first. A negative range is unknown: such a ray informs only about its hit and colour.
    """
    field, likelihood, config = shared
    seen, solids = item
    pose = Pose(yaw=seen.turn[0], x=seen.turn[1], y=seen.turn[2], log_scale=seen.turn[3], z=jnp.zeros(()))
    scale = jnp.exp(pose.log_scale)
    rays = Rays(origin=_to_view(pose, seen.origin), direction=_turn(pose, seen.direction))
    n = config.object_rays
    count = seen.range.shape[0]
    observation = Observation(
        rays=rays,
        status=jnp.where(jnp.arange(count) < n, OBJECT, FREE),
        rgb=seen.rgb,
        rgb_valid=jnp.ones(count, bool),
        range=seen.range * scale,
        range_sigma=jnp.full((count,), 0.01),
        range_valid=seen.range > 0,
        limit=jnp.full((count,), 0.5 * foam.FAR),
        pose_sigma=jnp.zeros(5),
        colour_count=n,
    )
    t = foam.crossings(rays, likelihood.lattice)
    fit = config.effective_rays * weighted_terms(field, weights, pose, likelihood, observation, t, seen.weight)
    return fit if solids is None else fit + solid_terms(shared, solids, weights)


def _turn(pose: Pose, d: Array) -> Array:
    c, s = jnp.cos(pose.yaw), jnp.sin(pose.yaw)
    return jnp.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]], axis=-1)


def _to_view(pose: Pose, p: Array) -> Array:
    """Canonical points in the view frame: the inverse of Pose.to_object."""
    base = jnp.array([0.0, 0.0, foam.BASE_Z])
    return jnp.exp(pose.log_scale) * _turn(pose, p - base) + base + jnp.stack([pose.x, pose.y, pose.z])


def loss(
    networks: tuple[ProbNeRF, Recognition],
    solids: ShapeBatch | None,
    batch: Batch | None,
    key: Array,
    kl_weight: Array,
    likelihood: Likelihood,
    config: TrainConfig,
    mesh: Mesh | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Negative ELBO per object, with q(z) from recognition, and its parts.

    With `batch`, it includes rays and the encoder's loss. Without `solids`, q(z) comes from the encoder, and only rays
    are used. `mesh` holds the processes' devices that share the objects.
    """
    model, recognition = networks
    k0, k1, k2 = jax.random.split(key, 3)
    if solids is None:
        assert batch is not None, "neither solids nor rays"
        mean, precision = encode(model, batch)
    else:
        mean, precision = jax.vmap(recognition)(solids.description)
    z = mean + jax.random.normal(k0, mean.shape) / jnp.sqrt(precision)
    kl = jnp.mean(jax.vmap(kl_estimate, in_axes=(None, 0, 0, 0))(model, z, mean, precision))
    weights = jax.vmap(model.hyper)(z)
    each: tuple | None = None
    if solids is not None:
        others = points_of_others(solids, k2, config.points_of_others) if config.points_of_others else None
        each = (solids.points, solids.inside, *colour_samples(solids, k1), solids.rgb, solids.valid, others)
        each = jax.tree.map(jnp.asarray, each)
    terms, encoder = solid_terms, jnp.zeros(())
    if batch is not None:
        drawn = (batch.origin, batch.direction, batch.ray_rgb, batch.ray_range, batch.ray_weight, batch.turn)
        terms, each = _ray_terms, (_ObjectRays(*map(jnp.asarray, drawn)), each)
        encoder = encoder_loss(model, batch, z) if solids is not None else encoder
    bound = _Bound(terms, (model.field, likelihood, config))
    mapped = share_by_share(partial(map_with_gradient, bound, config.map_batch, None), mesh)
    fit = jnp.mean(mapped(each, weights))
    return kl_weight * kl - fit + encoder, {"fit": fit, "kl": kl, "encoder": encoder}


@dataclass(frozen=True)
class _Bound:
    """A function with bound constants. It is hashable, so it can be a static argument."""

    terms: Callable
    constants: tuple

    def __call__(self, _: Any, item: Any, weights: Array) -> Array:
        return self.terms(self.constants, item, weights)


class TrainState(eqx.Module):
    """All state that a resumed run needs. Batches and keys depend only on the step and the seed."""

    model: ProbNeRF
    recognition: Recognition
    optimiser: optax.OptState
    step: Array


def optimiser_of(config: TrainConfig) -> optax.GradientTransformation:
    """Adam (paper §2.2) with gradient clipping against rare bad batches, and warm-up and cosine decay in each phase."""

    def schedule(solid: float, ray: float, frozen: int = 0) -> optax.Schedule:
        """Nothing in the frozen steps, then each phase's rise to its peak, level part and fall."""
        first = min(config.solid_steps, config.steps)
        still = min(frozen, first)
        parts = [
            optax.join_schedules(
                [
                    optax.linear_schedule(0.0, peak, warm := min(config.warmup, steps // 4)),
                    optax.constant_schedule(peak),
                    optax.cosine_decay_schedule(
                        peak, max(steps - int(config.level * steps), 1), config.final_learning_rate / peak
                    ),
                ],
                [warm, int(config.level * steps)],
            )
            for peak, steps in ((solid, first - still), (ray, config.steps - first))
        ]
        return optax.join_schedules([optax.constant_schedule(0.0), *parts], [still, first])

    def named(name: str, network: Any) -> Any:
        return jax.tree.map(lambda _: name, network)

    def labels(networks: tuple[ProbNeRF, Recognition]) -> tuple[ProbNeRF, Recognition]:
        model, recognition = networks
        decoder = eqx.tree_at(lambda m: m.encoder, named("decoder", model), named("encoder", model.encoder))
        if config.same_latents:
            decoder = eqx.tree_at(lambda m: m.flow, decoder, named("still", model.flow))
        return decoder, named("still" if config.same_latents else "recognition", recognition)

    rates = {
        "decoder": optax.adam(schedule(config.learning_rate, config.ray_learning_rate, config.frozen_steps)),
        "recognition": optax.adam(schedule(config.learning_rate, config.ray_learning_rate)),
        "encoder": optax.adam(schedule(config.learning_rate, config.learning_rate)),  # unused in the solid phase
        "still": optax.set_to_zero(),
    }
    return optax.chain(optax.clip_by_global_norm(200.0), optax.multi_transform(rates, labels))


def initial_state(model: ProbNeRF, config: TrainConfig, recognition: Recognition | None = None) -> TrainState:
    """The state of a new run. Without a recognition it begins with a random one."""
    key = jax.random.fold_in(jax.random.key(config.seed), 1)
    if recognition is None:
        recognition = Recognition(DESCRIPTION, model.latent, model.preset.hyper_hidden, key)
    optimiser = optimiser_of(config).init((model, recognition))
    return TrainState(model, recognition, optimiser, jnp.zeros((), jnp.int32))


def updated(
    static: tuple[Likelihood, TrainConfig],
    state: TrainState,
    solids: ShapeBatch | None,
    batch: Batch | None,
    mesh: Mesh | None = None,
) -> tuple[TrainState, dict[str, Array]]:
    """One update. Without `batch`, it is a step of the solid phase. `mesh`: as in `loss`."""
    likelihood, config = static
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    kl_weight = jnp.clip(state.step / config.kl_warmup, 0.02, 1.0)
    (value, parts), gradient = jax.value_and_grad(loss, has_aux=True)(
        (state.model, state.recognition), solids, batch, key, kl_weight, likelihood, config, mesh
    )
    update, optimiser = optimiser_of(config).update(gradient, state.optimiser)
    model, recognition = optax.apply_updates((state.model, state.recognition), update)
    return TrainState(model, recognition, optimiser, state.step + 1), {"loss": value, **parts}


train_step = eqx.filter_jit(updated, donate="all-except-first")


def train(
    model: ProbNeRF,
    solids: Sequence[tuple[ShapeSet, float]],
    views: ViewSet | None,
    likelihood: Likelihood,
    config: TrainConfig,
    folder: Path,
    recognition: Recognition | None = None,
    mesh: Mesh | None = None,
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Run or resume in `folder`; yields (state, metrics) every `log_every` steps and appends them to history.jsonl.

    `solids` are sets of shapes and their shares of each batch; `views` are pictures of the first set's first objects,
    None where there is a solid phase alone. Without solids, there is no solid phase, and training uses only pictures.
    Raises FloatingPointError with the step if the loss is not finite. The last checkpoint is kept. With a `mesh`
    (`processes.joined`), all processes call this alike, and the first one reads and writes the folder.
    """
    if not solids and config.solid_steps:
        raise ValueError(f"solid_steps is {config.solid_steps}; it must be 0 where there are pictures alone")
    if views is None and config.steps > config.solid_steps:
        raise ValueError(
            f"solid_steps is {config.solid_steps}; it must be all {config.steps} steps where there are no pictures"
        )
    if views is not None and config.steps > config.solid_steps and views.rgb.shape[1] < config.views:
        raise ValueError(f"--views is {config.views} but objects have {views.rgb.shape[1]} pictures; give no more")
    run = RunFolder(folder, config)
    # a copy, because a step donates its input buffers
    state = initial_state(jax.tree.map(jnp.copy, model), config, jax.tree.map(jnp.copy, recognition))
    state = everywhere(run.resume(state) if is_first() else state, mesh)
    strata = None if views is None else strata_of(views)
    start = int(state.step)

    def data_of(step: int) -> tuple[ShapeBatch | None, Batch | None]:
        rng = np.random.default_rng([config.seed, step, 7])
        if step < config.solid_steps:
            return draw_shapes(solids, rng, config.batch, config.points, config.colours), None
        assert views is not None and strata is not None
        batch = draw_batch(views, strata, config, step, config.ray_batch)
        if not solids:
            return None, batch
        return batch_of(solids[0][0], rng, np.asarray(batch.rows), config.points, config.colours), batch

    with ThreadPoolExecutor(1) as drawer:  # the next batch is drawn while this one is used
        coming = drawer.submit(data_of, start)
        for step in range(start, config.steps):
            data = coming.result()
            coming = drawer.submit(data_of, step + 1)
            state, parts = train_step((likelihood, config), state, *shares(data, mesh), mesh)
            done = step + 1
            if done % config.log_every == 0 or done == config.steps:
                metrics = {k: float(v) for k, v in parts.items()}
                if not np.isfinite(metrics["loss"]):
                    raise FloatingPointError(
                        f"loss is {metrics['loss']} at step {done}; {run.checkpoint} holds an earlier step"
                    )
                if is_first():
                    run.record({"step": done, "rays": step >= config.solid_steps, **metrics})
                    if done % config.checkpoint_every == 0 or done == config.steps:
                        run.save(state)
                yield state, {"step": done, **metrics}
