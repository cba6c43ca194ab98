"""Fit a prior's flow to objects that its other parts did not learn: `python -m benchmarks.household.flow`.

A flow that is trained with its decoder knows the latents of its training objects. Others lie outside of its law: the
mean square of their z~ is above 1, so a posterior holds back from them. Here the decoder and the recognition stay as
they are, and the flow climbs the likelihood of what recognition tells of fresh objects. The weights that are best on
held-out ones of them are kept.
"""

from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Float

from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from probnerf.prior.checkpoint import load_prior, load_recognition, recognition_path, save_prior, save_recognition
from probnerf.prior.networks import RealNVP, Recognition
from probnerf.training.picture_set import recognised
from probnerf.training.shape_set import batch_of, load_shapes
from probnerf.types import on_device

BLOCK = 32  # shapes described at a time


@dataclass(frozen=True)
class Options:
    """Fit the flow of a prior to fresh objects."""

    prior: Path
    """Weights; the recognition must lie beside them."""
    work: Path
    """Folder with the shapes (*.shapes) of objects that the prior did not learn (`objects.make` leaves them)."""
    out: Path = Path("runs/household-flow")
    """Folder of the prior and its recognition. A network must be trained for it anew."""
    steps: int = 1000
    batch: int = 256
    learning_rate: float = 3e-4
    held_out: float = 0.2
    """Share of the objects by which the step is chosen."""


def log_prior(flow: RealNVP, z: Float[Array, "n k"]) -> Float[Array, "n"]:
    """log p(z) of the flow, nats."""
    return _judged(flow, z)[0]


@eqx.filter_jit
def _judged(flow: RealNVP, z: Float[Array, "n k"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """log p(z), nats, and the mean square of z~."""
    z_tilde, log_det = jax.vmap(flow.inverse)(z)
    square = jnp.mean(z_tilde**2, axis=1)
    return log_det - 0.5 * z.shape[1] * (square + jnp.log(2.0 * jnp.pi)), square


def latents(recognition: Recognition, work: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of z ([n, K] each) of the objects of all *.shapes of a folder."""
    told = []
    for path in sorted(work.glob("*.shapes")):
        shapes, rng = load_shapes(path), np.random.default_rng(0)
        for first in range(0, len(shapes) - BLOCK + 1, BLOCK):
            told.append(np.asarray(batch_of(shapes, rng, np.arange(first, first + BLOCK), 4, 1).description))
    if not told:
        raise ValueError(f"{work} has no shapes (*.shapes); `benchmarks.household.objects.make` makes them")
    means, sds = zip(*recognised(recognition, told), strict=True)
    return np.concatenate(means), np.concatenate(sds)


def fitted(
    flow: RealNVP, mean: np.ndarray, sd: np.ndarray, options: Options
) -> tuple[RealNVP, dict[str, dict[str, float]]]:
    """The flow that is best on held-out objects, and figures of it and of the given one on these."""
    order = np.random.default_rng(2).permutation(len(mean))
    kept, learnt = np.split(order, [round(options.held_out * len(mean))])
    optimiser = optax.adam(optax.cosine_decay_schedule(options.learning_rate, options.steps))
    state, best, told = optimiser.init(eqx.filter(flow, eqx.is_inexact_array)), flow, {}

    def draws(rows: np.ndarray, rng: np.random.Generator) -> Float[Array, "n k"]:
        return on_device(mean[rows] + sd[rows] * rng.standard_normal((len(rows), mean.shape[1])))

    judged_by = draws(kept, np.random.default_rng(3))

    def judged(flow: RealNVP) -> dict[str, float]:
        each, squares = (np.asarray(a) for a in _judged(flow, judged_by))
        told = {"log_prior": each.mean(), "median": np.median(each), "mean_square": squares.mean()}
        return {name: round(float(value), 2) for name, value in told.items()}

    @eqx.filter_jit
    def step(flow, state, z):
        value, gradient = eqx.filter_value_and_grad(lambda flow: -jnp.mean(log_prior(flow, z)))(flow)
        update, state = optimiser.update(gradient, state, flow)
        return eqx.apply_updates(flow, update), state, value

    told["before"] = told["after"] = judged(flow)
    rng = np.random.default_rng(4)
    for done in range(1, options.steps + 1):
        flow, state, _ = step(flow, state, draws(rng.choice(learnt, options.batch), rng))
        if done % 50 == 0 and (figures := judged(flow))["log_prior"] > told["after"]["log_prior"]:
            best, told["after"] = flow, figures | {"step": done}
    return best, told


def main(options: Options) -> None:
    """Fit, and write the prior and its recognition."""
    prior = load_prior(options.prior)
    recognition = load_recognition(recognition_path(options.prior), prior)
    mean, sd = latents(recognition, options.work)
    flow, told = fitted(prior.model.flow, mean, sd, options)
    say(f"{len(mean)} objects; held out: {told}")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "prior.safetensors"
    story = {"flow_fitted": {"of": prior.hash, "objects": len(mean), "revision": revision(), **told}}
    save_prior(path, eqx.tree_at(lambda m: m.flow, prior.model, flow), prior.metadata | story, half=True)
    save_recognition(recognition_path(path), recognition, load_prior(path).hash)


if __name__ == "__main__":
    main(tyro.cli(Options))
