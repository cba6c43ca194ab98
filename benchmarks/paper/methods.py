"""How a picture of known pose is answered: the paper's methods and this project's own, through one interface.

HMC is the paper's: 8 chains from the prior, 100 iterations of 100 leapfrog steps, annealed from s = 5 to 0.1, the last
16 states of each chain kept. `Effort` shortens it for a small machine; the rows say by how much. VI is mean-field with
sticking-the-landing gradients, 1500 steps, from the best of the encoder's and the prior's draws. Each comes with the
weights' perturbation delta and without. All share model, pixels and likelihood.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.harness.results import Line
from benchmarks.paper.conditioned import Conditioned
from benchmarks.rivals.methods import weighted_posterior
from probnerf.inference import infer, likelihood_of
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.networks import ProbNeRF
from probnerf.prior.posterior_network import guesses
from probnerf.sampling.annealed_hmc import annealed_hmc
from probnerf.sampling.mean_field import VIConfig, mean_field
from probnerf.sampling.modes import log_posterior
from probnerf.settings import AnnealedHMCConfig, InferConfig
from probnerf.types import Posterior

CHAINS, KEPT = 8, 16
STARTS = 128  # draws of encoder and prior each, of which the best begins VI
VI_DRAWS = 16
FIXED_STEP = 0.0005  # the paper's, at the last temperature
DELTA_SCALE = 0.025  # sqrt(alpha), the paper's
SWEPT = (0.005, 0.01, 0.05)  # others that are tried


@dataclass(frozen=True)
class Effort:
    """How much of the paper's schedule is run."""

    iterations: int = 100
    leapfrog_steps: int = 100
    vi_steps: int = 1500

    @property
    def settings(self) -> Line:
        """What rows keep of it."""
        return {"schedule": f"{self.iterations}x{self.leapfrog_steps}", "vi_steps": self.vi_steps}


SHORT = Effort(iterations=40, leapfrog_steps=25, vi_steps=600)


@dataclass(frozen=True, eq=False)
class Question:
    """A picture, and with what it is answered."""

    view: Conditioned
    model: ProbNeRF
    effort: Effort
    seed: int

    def config(self, delta: bool) -> InferConfig:
        """The pixel likelihood of all methods: s = 0.1 as in the paper, four pixels a ray."""
        return InferConfig(colour_sigma=0.1, power=4.0, sample_delta=delta, network_starts=False, encoder_starts=False)

    @property
    def key(self) -> Array:
        """Of the method's randomness."""
        return jax.random.fold_in(jax.random.key(self.seed), self.view.seed)


@dataclass(frozen=True, eq=False)
class Found:
    """Positions with weights."""

    posterior: Posterior
    likelihood: Likelihood
    gradients: float  # of whole positions


@dataclass(frozen=True)
class Method:
    """One way to answer. `settings` and the effort's own make it another method."""

    name: str
    answer: Callable[[Question], Found] = field(compare=False)
    delta: bool = False
    delta_scale: float = DELTA_SCALE

    def settings(self, effort: Effort) -> Line:
        """What its rows keep."""
        scale = {} if self.delta_scale == DELTA_SCALE else {"delta_scale": self.delta_scale}
        return {**effort.settings, "delta": self.delta, **scale}


def _hmc(
    delta: bool, fixed: float | None = None, delta_scale: float = DELTA_SCALE, tuned: bool = False
) -> Callable[[Question], Found]:
    def answer(q: Question) -> Found:
        keep = max(1, round(KEPT * q.effort.iterations / 100))
        hmc = AnnealedHMCConfig(
            chains=CHAINS, iterations=q.effort.iterations, leapfrog_steps=q.effort.leapfrog_steps, keep=keep
        )
        if fixed is not None:  # one temperature, the last; the step is proportional to s
            hmc = replace(hmc, s_start=hmc.s_end, step_per_scale=fixed / hmc.s_end)
            hmc = hmc if tuned else replace(hmc, tune_iterations=0)
        observation = q.view.observation(q.seed)
        likelihood = replace(likelihood_of(q.config(delta), observation, sample_pose=False), delta_scale=delta_scale)
        args = (q.model, likelihood, observation, faces_of_view(observation, likelihood))
        posterior = annealed_hmc(q.key, log_likelihood, args, likelihood.dim(q.model), hmc)
        return Found(posterior, likelihood, float(posterior.diagnostics.point_gradients))

    return answer


def _vi(delta: bool) -> Callable[[Question], Found]:
    def answer(q: Question) -> Found:
        observation = q.view.observation(q.seed)
        likelihood = likelihood_of(q.config(delta), observation, sample_pose=False)
        args = (q.model, likelihood, observation, faces_of_view(observation, likelihood))
        start = _best_start(q, args)
        start = jnp.pad(start, (0, likelihood.dim(q.model) - len(start)))  # delta begins at 0
        config = VIConfig(steps=q.effort.vi_steps)
        found, _ = mean_field(q.key, log_likelihood, args, start, config)
        noise = jax.random.normal(jax.random.fold_in(q.key, 1), (VI_DRAWS, len(start)))
        gradients = float(config.steps * config.draws)
        return Found(weighted_posterior(found.draw(noise), np.ones(VI_DRAWS), gradients), likelihood, gradients)

    return answer


def _best_start(q: Question, args: tuple) -> Float[Array, "k"]:
    drawn = jnp.concatenate([_encoded(q, STARTS), jax.random.normal(q.key, (STARTS, q.model.latent))])
    plain = _without_delta(args)
    return drawn[int(jnp.argmax(jnp.nan_to_num(jax.jit(log_posterior)(plain, None, drawn), nan=-jnp.inf)))]


def _without_delta(args: tuple) -> tuple:
    model, likelihood, observation, faces = args
    return model, replace(likelihood, sample_delta=False), observation, faces


def _encoded(q: Question, count: int) -> Float[Array, "count k"]:
    return guesses(jax.random.fold_in(q.key, 2), q.model, q.view.picture, count, sample_pose=False)


def _encoder(q: Question) -> Found:
    observation = q.view.observation(q.seed)
    likelihood = likelihood_of(q.config(False), observation, sample_pose=False)
    return Found(weighted_posterior(_encoded(q, VI_DRAWS), np.ones(VI_DRAWS), 0.0), likelihood, 0.0)


def _prior(q: Question) -> Found:
    observation = q.view.observation(q.seed)
    likelihood = likelihood_of(q.config(False), observation, sample_pose=False)
    drawn = jax.random.normal(q.key, (4 * VI_DRAWS, q.model.latent))
    return Found(weighted_posterior(drawn, np.ones(len(drawn)), 0.0), likelihood, 0.0)


def _own(q: Question) -> Found:
    posterior, likelihood = infer(q.key, q.model, q.view.observation(q.seed), q.config(False), sample_pose=False)
    return Found(posterior, likelihood, float(posterior.diagnostics.point_gradients))


HMC, VI = Method("hmc", _hmc(False)), Method("vi", _vi(False))
HMC_DELTA, VI_DELTA = Method("hmc, delta", _hmc(True), delta=True), Method("vi, delta", _vi(True), delta=True)
FIXED = Method("fixed temperature", _hmc(False, fixed=FIXED_STEP))
FIXED_TUNED = Method("fixed temperature, tuned step", _hmc(False, fixed=FIXED_STEP, tuned=True))
SWEEP = tuple(
    Method(f"hmc, delta x {scale:g}", _hmc(True, delta_scale=scale), delta=True, delta_scale=scale) for scale in SWEPT
)
OWN, ENCODER, PRIOR = Method("tempered smc", _own), Method("encoder alone", _encoder), Method("the prior alone", _prior)
METHODS = (HMC, HMC_DELTA, VI, VI_DELTA, OWN, ENCODER, PRIOR)
