"""How Functa is trained: the field by meta-learning, then the functaset, then both priors of its latents."""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from benchmarks.rivals.functa import Functa, FunctaConfig
from benchmarks.rivals.recipe import Metrics, Phase, Recipe, descend, optimiser, rate
from benchmarks.rivals.volume import Pictures, draw_rays

FIELD_RATE, PRIOR_RATE = 1e-3, 5e-4
FIELD_SHARE = 0.75  # of the time
FUNCTA_RAYS = 512  # an inner step when the functaset is made
PASSES = 2  # latents of each object, from different rays: they tell the priors how exact latents are
KEPT_BACK = 0.05  # of the functaset, for choosing the priors' best weights
BATCH = 256  # latents
JITTER = 0.05  # of latents that priors learn from, in deviations: there are few
QUICK_STEPS = 300  # of the MAP search, when the model is examined
PRIORS = ("flow", "diffusion")


class FieldState(eqx.Module):
    """While the field learns."""

    model: Functa
    optimiser: Any


class Best(eqx.Module):
    """The weights of a prior that explain latents best which it does not learn from."""

    prior: Any
    loss: Float[Array, ""]


class PriorState(eqx.Module):
    """While the priors learn."""

    model: Functa
    optimisers: dict[str, Any]
    learnt: Float[Array, "n k"]  # in deviations from the mean
    kept_back: Float[Array, "m k"]
    best: dict[str, Best]


def functum(
    model: Functa, pictures: Pictures, objects: Int[Array, "b"], rays: int, key: PRNGKeyArray
) -> tuple[Float[Array, "b k"], Float[Array, "i"]]:
    """Latents of objects by gradient steps from zero, each with new rays of any views; the loss before each step."""

    def adapt(latent, key):
        loss, gradient = jax.value_and_grad(misfit)(latent, model, pictures, objects, rays, key)
        return latent - jnp.exp(model.log_step) * gradient, loss / len(objects)

    start = jnp.zeros((len(objects), model.config.latent))
    return jax.lax.scan(jax.checkpoint(adapt), start, jax.random.split(key, model.config.inner_steps))


def misfit(
    latent: Float[Array, "b k"],
    model: Functa,
    pictures: Pictures,
    objects: Int[Array, "b"],
    rays: int,
    key: PRNGKeyArray,
) -> Float[Array, ""]:
    """Mean squared error of random rays of these objects' pictures, summed over objects."""
    k0, k1, k2 = jax.random.split(key, 3)
    views = jax.random.randint(k0, (len(objects), rays), 0, pictures.rgb.shape[1])
    drawn = draw_rays(pictures, objects, views, k1)
    colours = partial(model.colours, samples=model.config.training_samples)
    rgb = jax.vmap(colours)(latent, drawn.origin, drawn.direction, jax.random.split(k2, len(objects)))
    return jnp.sum(jnp.mean(drawn.weight * jnp.mean((rgb - drawn.rgb) ** 2, axis=-1), axis=-1))


def field_step(
    state: FieldState, pictures: Pictures, progress: Float[Array, ""], key: PRNGKeyArray
) -> tuple[FieldState, Metrics]:
    """Adam on the loss after the inner steps, whose gradient passes through them (CAVIA; Dupont et al., alg. 1)."""
    config = state.model.config
    k0, k1, k2 = jax.random.split(key, 3)
    objects = jax.random.randint(k0, (config.objects,), 0, len(pictures.rgb))

    def loss(model):
        latent, before = functum(model, pictures, objects, config.rays, k1)
        after = misfit(latent, model, pictures, objects, config.rays, k2) / config.objects
        return after, (before[0], jnp.sqrt(jnp.mean(latent**2)))

    (after, (before, size)), gradient = jax.value_and_grad(loss, has_aux=True)(state.model)
    model, kept = descend(state.model, gradient, state.optimiser, rate(progress, FIELD_RATE))
    psnr = -10.0 * jnp.log10(after)
    return FieldState(model, kept), {"mse_before": before, "mse": after, "psnr": psnr, "latent": size}


def make_functaset(state: FieldState, pictures: Pictures) -> PriorState:
    """Latents of all objects, normalised; and the priors' start."""
    model = state.model
    count, some = len(pictures.rgb), model.config.objects
    order = jnp.arange(-(-count // some) * some) % count

    def part(given):
        return functum(model, pictures, given[0], FUNCTA_RAYS, given[1])[0]

    def whole(key):
        keys = jax.random.split(key, len(order) // some)
        return jax.lax.map(part, (order.reshape(-1, some), keys)).reshape(len(order), -1)[:count]

    latents = jax.lax.map(whole, jax.random.split(jax.random.key(0), PASSES))
    mean, deviation = jnp.mean(latents, axis=(0, 1)), jnp.std(latents, axis=(0, 1)) + 1e-6
    model = eqx.tree_at(lambda m: (m.mean, m.deviation), model, (mean, deviation))
    latents = (latents - mean) / deviation
    back = max(1, round(KEPT_BACK * count))
    learnt, kept_back = (part.reshape(-1, part.shape[-1]) for part in (latents[:, back:], latents[:, :back]))
    optimisers = {name: optimiser().init(getattr(model, name)) for name in PRIORS}
    best = {name: Best(getattr(model, name), jnp.array(jnp.inf)) for name in PRIORS}
    return PriorState(model, optimisers, learnt, kept_back, best)


def prior_loss(name: str, prior: Any, latents: Float[Array, "n k"], key: PRNGKeyArray) -> Float[Array, ""]:
    """Nats a dimension of the flow, up to a constant; or the diffusion model's loss."""
    if name == "diffusion":
        return prior.loss(latents, key)
    normal, log_det = jax.vmap(prior.inverse)(latents)
    return jnp.mean(0.5 * jnp.sum(normal**2, axis=-1) - log_det) / latents.shape[1]


def prior_step(
    state: PriorState, pictures: Pictures, progress: Float[Array, ""], key: PRNGKeyArray
) -> tuple[PriorState, Metrics]:
    """Adam on both priors. Those weights are kept that explain the latents kept back best."""
    k0, k1, k2 = jax.random.split(key, 3)
    rows = jax.random.randint(k0, (BATCH,), 0, len(state.learnt))
    latents = state.learnt[rows] + JITTER * jax.random.normal(k1, (BATCH, state.learnt.shape[1]))
    metrics: Metrics = {}
    found, kept, best = {}, {}, {}
    for name in PRIORS:
        before = getattr(state.model, name)
        loss, gradient = jax.value_and_grad(partial(prior_loss, name))(before, latents, k2)
        found[name], kept[name] = descend(before, gradient, state.optimisers[name], rate(progress, PRIOR_RATE))
        # always with the same noise, to compare
        back = prior_loss(name, found[name], state.kept_back, jax.random.key(0))
        now, better = Best(found[name], back), back < state.best[name].loss
        best[name] = jax.tree.map(lambda new, old, better=better: jnp.where(better, new, old), now, state.best[name])
        metrics |= {f"{name}_loss": loss, f"{name}_kept_back": back, f"{name}_best": best[name].loss}
    model = eqx.tree_at(lambda m: (m.flow, m.diffusion), state.model, (found["flow"], found["diffusion"]))
    return PriorState(model, kept, state.learnt, state.kept_back, best), metrics


def best_model(state: FieldState | PriorState) -> Functa:
    """The model with its best priors."""
    if isinstance(state, FieldState):
        return state.model
    priors = (state.best["flow"].prior, state.best["diffusion"].prior)
    return eqx.tree_at(lambda m: (m.flow, m.diffusion), state.model, priors)


def quick(model: Functa) -> Functa:
    """The model with a shorter search for the MAP latent."""
    config = replace(model.config, map_steps=min(model.config.map_steps, QUICK_STEPS))
    structure = jax.tree.structure(jax.eval_shape(lambda key: Functa(config, key), jax.random.key(0)))
    return jax.tree.unflatten(structure, jax.tree.leaves(model))


def functa_recipe(config: FunctaConfig) -> Recipe:
    """The field, then the priors."""

    def start(key: PRNGKeyArray) -> FieldState:
        model = Functa(config, key)
        return FieldState(model, optimiser().init(model))

    field = Phase("field", field_step, FIELD_SHARE)
    priors = Phase("priors", prior_step, 1.0 - FIELD_SHARE, make_functaset)
    return Recipe(start, (field, priors), best_model, quick)
