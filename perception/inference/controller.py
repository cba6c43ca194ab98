"""Adaptive inference: from a frame's segment to published hypotheses, with as many sampler runs as the scene needs.

If the prior has a posterior network, its draws are the first answer. Where their importance weights are good enough,
these are the last one. Else sampling begins there.

A run is a small sampler: a few independent populations of a few particles. Without a network, they begin where climbs
from the encoder's guesses end. From the populations' disagreement about unseen space follows the score that their small
number is expected to lose there (`publish.expected_loss`). If it is above the tolerance, the controller makes the
further runs that should reduce it enough (it falls with their number), and pools their populations. If the shapes leave
too many pixels unexplained (a posterior-predictive check), it makes all allowed runs. An answer can be published from
the start, and a better one after each step.

Lattice and rays are the same for every scene. With half of both, shapes were worse on easy and hard scenes, and no
check predicted where (`farside bench frontier` can measure a coarse lattice).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from perception.answers.hypotheses import Hypotheses
from perception.inference.limits import NO_CALLBACKS, NO_LIMITS, Callbacks, Limits
from perception.inference.publish import ConditionedView, published
from perception.inference.run_plan import Findings, runs_wanted
from perception.inference.settings import ControllerConfig, PublishConfig
from perception.inference.view_sampler import ViewSampler
from perception.observation.object_frame import ObjectFrame
from perception.observation.rays import observe
from perception.observation.segmentation import Segment
from perception.observation.visibility import seen_voxels
from perception.sources.frame import Frame
from probnerf.inference import suited
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import Prior
from probnerf.sampling.hmc import StageInfo
from probnerf.sampling.importance import WeighedDraws
from probnerf.sampling.populations import pooled
from probnerf.types import Observation, Posterior, StopReason


@dataclass(frozen=True, eq=False)
class Estimate:
    """The inference result of one object: the published hypotheses and their sources."""

    hypotheses: Hypotheses
    posterior: Posterior
    likelihood: Likelihood
    observation: Observation
    object_frame: ObjectFrame
    seconds: float
    log: tuple[str, ...] = ()  # why there were more runs, and why no more, a line an answer
    parts: dict[str, float] = field(default_factory=dict)  # s; of them: network, climbing, sampling, publishing
    start: str = ""  # where sampling began, in words


def estimate(
    frame: Frame,
    segment: Segment,
    prior: Prior,
    config: ControllerConfig | None = None,
    *,
    seed: int = 0,
    known: ObjectFrame | None = None,
    budget_s: float | None = None,
    stages: int | None = None,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    on_answer: Callable[[Hypotheses], None] | None = None,
) -> Estimate:
    """Hypotheses about one object of a frame; first ones, made more cheaply, go to `on_answer` while it works.

    With `stages` and no budget the answer is a function of the inputs alone. `known` is the object's own cube where its
    pose is known already (the handle at +x), so that only its shape is inferred.

    Raises ValueError where the segment cannot be observed (too small, outside the prior's range of sizes).
    """
    config = config or ControllerConfig()
    limits = Limits(None if budget_s is None else time.monotonic() + budget_s, stages)
    observation, cube = observe(frame, segment, config.observe, seed, known)
    seen = seen_voxels(frame, segment, cube, config.grid)
    view = ConditionedView(frame, segment, observation, cube, seen, pose_known=known is not None)
    return infer_view(view, prior, config, seed=seed, limits=limits, callbacks=Callbacks(on_stage, on_answer))


def infer_view(
    view: ConditionedView,
    prior: Prior,
    config: ControllerConfig,
    *,
    seed: int = 0,
    before: Posterior | None = None,
    limits: Limits = NO_LIMITS,
    callbacks: Callbacks = NO_CALLBACKS,
) -> Estimate:
    """Sample the posterior of a view and publish it, in as many runs as it takes (`run_plan.runs_wanted`).

    `before` is an interrupted posterior of the same view; one run continues from it. The limits are for all runs
    together. A further run that is cut short is left out.
    """
    begun = time.monotonic()
    sampler = ViewSampler(view, prior, suited(config.infer, prior.model), seed, limits, before)
    publisher = _Publisher(sampler, config, callbacks)
    may_grow = before is None and config.infer.method == "tempered_smc"
    runs: list[Posterior] = []
    wanted, stop, log = 1, None, list[str]()
    if sampler.asks_network:
        publisher.hand_out_guess()
        draws = sampler.weigh()
        if draws is not None:
            enough = draws.suffice(config.infer.network)
            log.append(publisher.draws_line(draws, enough))
            if enough:  # nothing is left to sample
                runs = [draws.posterior()]
                answer = publisher.publish_draws(runs[0])
    elif sampler.asks_encoder:
        publisher.hand_out_guess()
        sampler.climb()
    while stop is None and len(runs) < wanted:
        new, stop = sampler.more_runs(len(runs), wanted, publisher.after_stage)
        if new:
            runs += new
            answer = publisher.publish_runs(runs)
            found = Findings(len(runs), answer.diagnostics.expected_loss, 1.0 - answer.diagnostics.explained)
            if may_grow and stop is None:
                wanted = runs_wanted(found, config.runs, config.tolerance, config.unexplained)
            log.append(publisher.log_line(found, answer.failed, wanted if stop is None else len(runs)))
        if stop is None and len(runs) < wanted:
            stop = sampler.limit_reached()
            if stop is None:  # better ones follow
                publisher.hand_out(replace(answer, result=StopReason.UNDERWAY))
    if stop is not None and len(runs) < wanted:
        log.append(f"no room for more ({stop})")
        answer, runs[-1] = replace(answer, result=stop, stage=sampler.stages), replace(runs[-1], result=stop)
    publisher.hand_out(answer)
    return Estimate(
        hypotheses=answer,
        posterior=pooled(runs, sampler.smc.evidence_power),
        likelihood=sampler.likelihood,
        observation=view.observation,
        object_frame=view.object_frame,
        seconds=time.monotonic() - begun,
        log=tuple(log),
        parts=sampler.stopwatch.seconds,
        start=sampler.start,
    )


@dataclass(eq=False)
class _Publisher:
    """Makes hypotheses from a view's samples, and publishes early ones until the first run is complete."""

    sampler: ViewSampler
    config: ControllerConfig
    callbacks: Callbacks
    _whole: bool = False  # a run is complete: no more early answers
    _early_at: float = field(default_factory=time.monotonic)  # when the last early answer was published
    _early_s: float = 0.0  # time that it took

    def publish_runs(self, runs: list[Posterior]) -> Hypotheses:
        """The answer of several runs together."""
        self._whole = True
        power = self.sampler.smc.evidence_power
        guess = self.sampler.guess() if self.sampler.asks_network else None
        return self._published(pooled(runs, power), self.config, power, guess)

    def publish_draws(self, draws: Posterior) -> Hypotheses:
        """The answer of weighed draws, whose weights are those of the posterior."""
        return self._published(draws, self.config, 1.0)

    def hand_out(self, answer: Hypotheses) -> None:
        """Pass an answer on, if anyone listens."""
        if self.callbacks.on_answer is not None:
            self.callbacks.on_answer(answer)

    def hand_out_guess(self) -> None:
        """Publish the network's or the encoder's guess, if the callbacks want it."""
        if self.callbacks.on_answer is not None and self.callbacks.guess:
            self._hand_out_early(self.sampler.guess())

    def after_stage(self, info: StageInfo) -> bool | None:
        """Pass a stage on, with an early answer of its samples where it is time for one; True ends the run.

        The first comes at once. To make a later one may take a tenth of the time that went by since the one before.
        """
        if self.callbacks.on_stage is not None and self.callbacks.on_stage(info):
            return True
        due = self._early_at + 9.0 * self._early_s
        if self.callbacks.on_answer is not None and not self._whole and time.monotonic() >= due:
            self._hand_out_early(info.samples())
        return None

    @staticmethod
    def draws_line(draws: WeighedDraws, enough: bool) -> str:
        """A log line: how good the weights of the network's draws are, and what follows."""
        line = f"{len(draws.log_weights)} draws of the network: ESS {draws.ess:.0f}, Pareto k {draws.k:.2f}"
        line += f", halves {draws.apart:.2f} nats apart"
        return line + (": no tempering is needed" if enough else " -> tempering from there")

    def log_line(self, found: Findings, failed: int, wanted: int) -> str:
        """A log line: the findings of the runs so far, and whether more are wanted."""
        line = f"{self._particles(found.runs)}: "
        known = np.isfinite(found.expected_loss)
        line += f"expected loss {found.expected_loss:.4f} nats" if known else "expected loss not known"
        line += f", {100 * found.unexplained:.0f}% of pixels not explained"
        if failed:
            line += f", populations that failed and are left out: {failed}"
        return line + (f" -> {self._particles(wanted)}" if wanted > found.runs else "")

    def _particles(self, runs: int) -> str:
        return f"{runs * self.sampler.smc.populations} x {self.sampler.smc.particles} particles"

    def _hand_out_early(self, posterior: Posterior) -> None:
        """An answer that is cheaper to make."""
        begun, config = time.monotonic(), self.config
        cheaper = replace(config, hypotheses=config.first_hypotheses, coarse=config.first_coarse)
        self.hand_out(self._published(posterior, cheaper, self.sampler.smc.evidence_power))
        self._early_at = time.monotonic()
        self._early_s = self._early_at - begun

    def _published(
        self, posterior: Posterior, config: PublishConfig, evidence_power: float, guess: Posterior | None = None
    ) -> Hypotheses:
        sampler = self.sampler
        with sampler.stopwatch.part("publishing"):
            h = published(
                sampler.view, posterior, sampler.likelihood, sampler.prior, config, sampler.seed,
                point_gradients=sampler.point_gradients, evidence_power=evidence_power, guess=guess,
            )  # fmt: skip
        return replace(h, stage=max(sampler.stages, h.stage), kinds=sampler.kinds)
