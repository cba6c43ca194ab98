"""The methods that `farside bench frontier` compares: a table, and one timed answer from frame to grids.

Seconds are of one object, from the frame to its solid grids, with all programs compiled before. `point_gradients` is a
cost that does not depend on the machine: evaluations of the field with its gradient, that is gradients of whole
positions times the crossings of the view. It also counts crossings whose gradient the kernel skips because they have
no influence, for all methods alike. The encoder alone takes only evaluations. The sampler's starts are evaluations,
too; only seconds count them. All methods get the same pixels, likelihood and prior.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.harness.results import Line, digest
from benchmarks.measures.scores import Answer, shapes_at
from benchmarks.rivals.quick import RivalConfig, encoder_alone, encoder_picture
from benchmarks.scenes.vessels import VesselView
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.observation.object_frame import ObjectFrame
from perception.observation.rays import observe
from perception.observation.visibility import answered_voxels
from probnerf.inference import crossings_of, infer, likelihood_of
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import Prior
from probnerf.prior.posterior_network import EncoderPicture, guesses
from probnerf.sampling.map_estimate import map_estimate
from probnerf.sampling.mean_field import VIConfig, mean_field
from probnerf.sampling.modes import log_posterior
from probnerf.sampling.populations import thin
from probnerf.settings import AnnealedHMCConfig
from probnerf.shapes import scaled_about
from probnerf.types import Diagnostics, Observation, Posterior, StopReason

DEPTHS = ("RGB-D", "colour only")
CONDITIONS = tuple(f"{handle}, {depth}" for handle in ("hidden", "informative") for depth in DEPTHS)
WITH_DEPTH = tuple(c for c in CONDITIONS if c.endswith(DEPTHS[0]))
TELLING = CONDITIONS[:1]  # where levers are compared
SAMPLERS = ("smc", "smc_from_prior", "smc_from_network")  # in `InferConfig`, each for another start
AT_PRIOR = {"encoder_starts": False, "network_starts": False}  # where inference begins


@dataclass(frozen=True, eq=False)
class Question:
    """One view, and all else that an answer depends on."""

    view: VesselView
    prior: Prior
    config: ControllerConfig
    seed: int

    @cached_property
    def observed(self) -> tuple[Observation, ObjectFrame]:
        known = self.view.cube if self.view.pose_known else None  # otherwise finding it is part of the time
        return observe(self.view.frame, self.view.segment, self.config.observe, self.seed, known)

    @property
    def key(self) -> Array:
        return jax.random.key(self.seed)

    @cached_property
    def likelihood(self) -> Likelihood:
        return likelihood_of(self.config.infer, self.observed[0], not self.view.pose_known)

    @property
    def arguments(self) -> tuple:
        """What `model.log_likelihood` takes."""
        observation = self.observed[0]
        return self.prior.model, self.likelihood, observation, faces_of_view(observation, self.likelihood)

    @property
    def picture(self) -> EncoderPicture:
        return encoder_picture(self.view, self.observed[1], self.prior)


@dataclass(frozen=True, eq=False)
class Sampled:
    """Weighted positions and their cost."""

    posterior: Posterior
    observation: Observation
    likelihood: Likelihood
    cube: ObjectFrame
    point_gradients: float
    point_evaluations: float = 0.0  # of the field alone, where there are no gradients
    seconds: float | None = None  # up to published grids; None: up to these positions, so that grids are still to come


@dataclass(frozen=True)
class Method:
    """One row of the table. `sample(question, True)` compiles what `sample(question, False)` needs, at less cost."""

    name: str
    group: str  # methods that a line joins
    label: str  # in the chart; a lever's begins with its letter
    sample: Callable[[Question, bool], Sampled] = field(compare=False)
    settings: dict[str, Any]  # that make it another method
    conditions: tuple[str, ...] = CONDITIONS
    programs: str = ""  # methods that compile the same; "": none
    smc: bool = False  # whether `InferConfig.smc` matters to it
    base: str = "smc"  # the method that it differs from by one lever


def weighted_posterior(positions: Float[Array, "s d"], weights: Float[np.ndarray, "s"], gradients: float) -> Posterior:
    """Positions of a method that is no sampler as samples of one population."""
    nan, zero = jnp.asarray(np.float32("nan")), jnp.zeros((), jnp.int32)
    with np.errstate(divide="ignore"):
        log_weights = jnp.asarray(np.log(weights / weights.sum()), jnp.float32)
    count = len(weights)
    diagnostics = Diagnostics(
        nan, zero, nan, nan, zero, zero, jnp.asarray(np.float32(gradients)), jnp.ones(1), jnp.full(1, nan)
    )
    values, population = jnp.full(count, nan), jnp.zeros(count, jnp.int32)
    return Posterior(positions, log_weights, values, values, population, nan, nan, diagnostics, StopReason.CONVERGED)


def _sampled(q: Question, posterior: Posterior, evaluations: float = 0.0) -> Sampled:
    (observation, cube), crossings = q.observed, crossings_of(q.likelihood, q.observed[0])
    gradients = crossings * float(posterior.diagnostics.point_gradients)
    return Sampled(posterior, observation, q.likelihood, cube, gradients, crossings * evaluations)


def _encoder() -> Method:
    config = RivalConfig()

    def sample(q: Question, _: bool) -> Sampled:
        drawn, weights = encoder_alone(q.key, q.prior.model, q.likelihood, q.observed[0], q.picture, config)
        return _sampled(q, weighted_posterior(drawn, weights, 0.0), evaluations=config.yaws * config.draws)

    return Method("encoder alone", "encoder", "encoder", sample, {"yaws": config.yaws, "draws": config.draws})


def _map() -> Method:
    config = RivalConfig()
    fit = config.fit

    def sample(q: Question, _: bool) -> Sampled:
        starts = guesses(q.key, q.prior.model, q.picture, config.yaws, q.likelihood.sample_pose)
        best, _ = map_estimate(q.prior.model, q.likelihood, q.observed[0], starts, fit)
        gradients = config.yaws * fit.screen_steps + fit.survivors * fit.steps
        return _sampled(
            q, weighted_posterior(best[None], np.ones(1), gradients), evaluations=config.yaws + fit.survivors
        )

    return Method("map", "map", "MAP", sample, {"yaws": config.yaws, **asdict(fit)})


def _vi(config: VIConfig) -> Method:
    yaws = RivalConfig().yaws

    def sample(q: Question, _: bool) -> Sampled:
        args = q.arguments
        starts = guesses(q.key, q.prior.model, q.picture, yaws, q.likelihood.sample_pose)
        at = int(jnp.argmax(jnp.nan_to_num(jax.jit(log_posterior)(args, None, starts), nan=-jnp.inf)))
        found, _ = mean_field(q.key, log_likelihood, args, starts[at], config)
        count = q.config.hypotheses
        noise = jax.random.normal(jax.random.fold_in(q.key, 1), (count, starts.shape[1]))
        drawn = weighted_posterior(found.draw(noise), np.full(count, 1.0 / count), config.steps * config.draws)
        return _sampled(q, drawn, evaluations=yaws)

    return Method("vi", "vi", "VI", sample, {"yaws": yaws, **asdict(config)})


def _hmc(name: str, group: str, hmc: AnnealedHMCConfig, conditions: tuple[str, ...] = CONDITIONS) -> Method:
    def sample(q: Question, short: bool) -> Sampled:
        config = replace(q.config.infer, method="annealed_hmc", hmc=hmc)
        known = q.view.pose_known
        posterior, _ = infer(
            q.key, q.prior.model, q.observed[0], config, sample_pose=not known, stages=1 if short else None
        )
        return _sampled(q, posterior)

    return Method(f"{name} {_schedule(hmc)}", group, _schedule(hmc), sample, asdict(hmc), conditions)


def _schedule(hmc: AnnealedHMCConfig) -> str:
    return f"{hmc.iterations}x{hmc.leapfrog_steps}"


def annealed(iterations: int, leapfrog_steps: int) -> AnnealedHMCConfig:
    """The paper's schedule, shortened: the same share of its end is kept, at the same temperatures."""
    keep = max(1, round(0.16 * iterations))
    return AnnealedHMCConfig(iterations=iterations, leapfrog_steps=leapfrog_steps, keep=keep)


def _estimate(
    name: str,
    group: str,
    label: str,
    *,
    stages: int | None = None,
    budget_s: float | None = None,
    infer: dict[str, Any] | None = None,
    smc: dict[str, Any] | None = None,
    runs: int | None = 1,
    conditions: tuple[str, ...] = CONDITIONS,
    base: str = "smc",
) -> Method:
    """Perception's own way, with other numbers of `InferConfig` and of its `smc`.

    So many `runs`, or with None the controller's own choice.
    """

    def sample(q: Question, short: bool) -> Sampled:
        """Perception's answer."""
        own = q.config.infer
        populations = {name: replace(getattr(own, name), **(smc or {})) for name in SAMPLERS}
        sampler = replace(own, **(infer or {}), **populations)
        limits = {"stages": None if stages is None else 2} if short else {"stages": stages, "budget_s": budget_s}
        config = replace(q.config, infer=sampler, runs=runs or q.config.runs)
        begun = time.monotonic()
        found = estimate(q.view.frame, q.view.segment, q.prior, config, seed=q.seed, **limits)
        seconds = time.monotonic() - begun
        gradients = found.hypotheses.diagnostics.point_gradients
        cube, likelihood = found.object_frame, found.likelihood
        return Sampled(found.posterior, found.observation, likelihood, cube, float(gradients), seconds=seconds)

    amount = {"runs": runs or ControllerConfig().runs}
    settings = {"stages": stages, "budget_s": budget_s, **amount, **(infer or {}), **(smc or {})}
    programs = "" if budget_s is None else group  # one budget compiles what another needs
    return Method(name, group, label, sample, settings, conditions, programs, smc=True, base=base)


def paper_schedule(hmc: AnnealedHMCConfig, conditions: tuple[str, ...] = CONDITIONS) -> Method:
    """The paper's sampler at some length."""
    return _hmc("paper", "paper", hmc, conditions)


CONTROLLER = _estimate("controller", "controller", "to the end", runs=None)
FROM_PRIOR = _estimate("from the prior", "controller", "from the prior", runs=None, infer=AT_PRIOR)
VI, PAPER = _vi(VIConfig()), paper_schedule(annealed(100, 100))
FULL = PAPER.name  # the paper's own schedule; it takes long
METHODS = (
    _encoder(),
    _map(),
    VI,
    paper_schedule(annealed(10, 10)),
    paper_schedule(annealed(20, 20)),
    paper_schedule(annealed(50, 50), WITH_DEPTH),
    PAPER,
    _hmc("fixed", "fixed temperature", replace(annealed(20, 100), s_start=0.1), TELLING),
    _estimate("smc", "smc", "x1", stages=60),
    _estimate("smc, 3 runs", "smc", "x3", stages=180, runs=3, conditions=TELLING),
    _estimate("smc, 6 runs", "smc", "x6", stages=360, runs=6, conditions=TELLING),
    _estimate(
        "smc, from the prior",
        "lever off",
        "P from the prior",
        stages=60,
        infer=AT_PRIOR,
        conditions=TELLING,
    ),
    _estimate(
        "smc, delta",
        "lever off",
        "D with delta, from the prior",
        stages=60,
        infer={"sample_delta": True},  # which begins at the prior
        conditions=TELLING,
        base="smc, from the prior",
    ),
    _estimate(
        "smc, one move", "lever off", "O one move a beta", stages=60, smc={"least_moved": 0.0}, conditions=TELLING
    ),
    _estimate("smc, lattice 16", "lever off", "C coarse lattice", stages=60, infer={"lattice": 16}, conditions=TELLING),
    _estimate("smc, power 1", "lever off", "K power 1", stages=60, infer={"power": 1.0}, conditions=TELLING),
    _estimate("smc, no metric", "lever off", "M prior's metric", stages=60, smc={"metric": False}, conditions=TELLING),
    _estimate(
        "smc, 6 leapfrog steps",
        "lever off",
        "L 6 leapfrog steps",
        stages=60,
        smc={"leapfrog_steps": 6},
        conditions=TELLING,
    ),
    _estimate("controller, 10 stages", "stages", "10 stages", stages=10, runs=None),
    *(_estimate(f"controller {s:g} s", "controller", f"{s:g} s", budget_s=s, runs=None) for s in (1.0, 3.0, 10.0)),
)


def settings_of(method: Method, config: ControllerConfig) -> Line:
    """A method's own settings, and a digest of all else that observation and inference were set to."""
    own = (*SAMPLERS, "modes", "network")  # of the sampler, which other methods do not have
    infer = {name: value for name, value in asdict(config.infer).items() if method.smc or name not in own}
    observe = {name: value for name, value in asdict(config.observe).items() if method.smc or name != "choices"}
    shared = {"infer": infer, "observe": observe, "hypotheses": config.hypotheses}
    return {**method.settings, "config": digest(shared)[:8]}


def answer(method: Method, question: Question, short: bool = False) -> tuple[Answer, Sampled, Float[Array, "S d"]]:
    """A method's shapes (`shapes_at`), what they were made from, and the position of each."""
    begun = time.monotonic()
    sampled = method.sample(question, short)
    posterior, count = sampled.posterior, question.config.hypotheses
    if len(posterior.log_weights) > count:
        chosen, weights, _ = thin(posterior, count)
    else:
        chosen = np.arange(len(posterior.log_weights))
        weights = np.exp(np.asarray(posterior.log_weights, np.float64))
    model = question.prior.model
    positions, pose_sigma = posterior.positions[jnp.asarray(chosen)], sampled.observation.pose_sigma
    if sampled.cube.sight_sigma > 0.0 and len(chosen) > 1:  # as perception publishes; one best shape is no draw
        drawn = jax.random.normal(jax.random.fold_in(question.key, 1), posterior.log_weights.shape)
        factor = sampled.cube.sight_sigma * drawn[jnp.asarray(chosen)]
        camera = jnp.asarray(sampled.cube.to_cube(np.zeros(3)), jnp.float32)
        positions = scaled_about(model, positions, pose_sigma, camera, factor)
    view = question.view
    region = jnp.asarray(answered_voxels(view.frame, view.segment, sampled.cube, question.config.grid))
    shapes = shapes_at(model, sampled.likelihood, positions, pose_sigma, region)
    seconds = time.monotonic() - begun if sampled.seconds is None else sampled.seconds
    return Answer(shapes, weights / weights.sum(), seconds, posterior.result), sampled, positions
