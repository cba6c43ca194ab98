"""One view's inference, a step at a time: first answer, runs of the sampler, published hypotheses.

If the prior has a posterior network, its draws are the first answer. Where their importance weights are good enough,
these are the last one. Else sampling begins there.

A run is a small sampler: a few independent populations of a few particles, each of which compares its own choice of the
view's pixels. Without a network, they begin where climbs from the encoder's guesses end. One run is the answer: with
more, whose populations are pooled, the mean score of 23 scans was the same (`farside bench runs`), whatever the
populations' disagreement about unseen space says that they are expected to gain (`publish.expected_loss`). An answer
can be published from the start, and a better one after each step.

Lattice and rays are the same for every scene. With half of both, shapes were worse on easy and hard scenes, and no
check predicted where (`farside bench frontier` can measure a coarse lattice).
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from perception.answers.hypotheses import Hypotheses
from perception.inference.limits import NO_CALLBACKS, NO_LIMITS, Callbacks, Limits
from perception.inference.publish import ConditionedView, published
from perception.inference.settings import ControllerConfig, PublishConfig
from perception.inference.view_sampler import ViewSampler
from perception.observation.object_frame import ObjectFrame
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
    log: tuple[str, ...] = ()  # what each answer found, and why there were no more, a line each
    parts: dict[str, float] = field(default_factory=dict)  # s; of them: network, climbing, sampling, publishing
    start: str = ""  # where sampling began, in words


@dataclass(eq=False)
class Inference:
    """Samples the posterior of a view and publishes it, in `config.runs` runs.

    `begin` first, then `step` until it is `done`. `before` is an interrupted posterior of the same view; one run
    continues from it. The limits are for all runs together. A further run that is cut short is left out.
    """

    view: ConditionedView
    prior: Prior
    config: ControllerConfig
    seed: int = 0
    before: Posterior | None = None
    limits: Limits = NO_LIMITS
    callbacks: Callbacks = NO_CALLBACKS
    answer: Hypotheses | None = None  # the latest; none before the first run where no guess was asked for
    done: bool = False  # nothing is left to do, or a limit leaves no room for more
    _runs: list[Posterior] = field(default_factory=list)
    _cut: bool = False  # the only run is one that a step's deadline ended
    _log: list[str] = field(default_factory=list)
    _seconds: float = 0.0

    def __post_init__(self) -> None:
        infer = suited(self.config.infer, self.prior.model)
        self._sampler = ViewSampler(self.view, self.prior, infer, self.seed, self.limits, self.before)
        self._publisher = _Publisher(self._sampler, self.config, self.callbacks)
        again = self.before is None and infer.method == "tempered_smc"
        self._wanted = self.config.runs if again else 1

    @property
    def loss(self) -> float:
        """What further runs may still gain, nats over all voxels of unseen space: infinite before a whole run."""
        if self.answer is None or not self._runs or self._cut:
            return float("inf")
        expected = self.answer.diagnostics.expected_loss
        unseen = float(np.count_nonzero(self.answer.unseen)) * self.answer.voxel_m**3
        return float(np.nan_to_num(expected, nan=1.0)) * unseen

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it."""
        return self.answer is not None and self.answer.result == StopReason.INTERRUPTED

    def guess(self) -> None:
        """Answer at once, by the network or the encoder, where there is one to ask and the callbacks allow a guess."""
        with self._counted():
            if self.callbacks.guess and (self._sampler.asks_network or self._sampler.asks_encoder):
                self.answer = self._publisher.hand_out_guess()

    def begin(self) -> None:
        """Make ready to sample, after a guess where the callbacks want it."""
        sampler, publisher = self._sampler, self._publisher
        if publisher.wants_guess and self.answer is None:
            self.guess()
        with self._counted():
            if sampler.asks_network:
                draws = sampler.weigh()
                if draws is not None:
                    enough = draws.suffice(self.config.infer.network)
                    self._log.append(publisher.draws_line(draws, enough))
                    if enough:  # nothing is left to sample
                        self._runs = [draws.posterior()]
                        self._end(publisher.publish_draws(self._runs[0]))
            elif sampler.asks_encoder:
                sampler.climb()

    def step(self, deadline: float | None = None) -> bool:
        """Make a run, and publish; whether there was room for it.

        A `deadline` (of `time.monotonic`) is this step's; the limits are those of all steps. If it ends the first run,
        that run's samples are the answer, and the next step begins anew.
        """
        with self._counted():
            return self._step(deadline)

    def _step(self, deadline: float | None) -> bool:
        sampler, publisher = self._sampler, self._publisher
        if self._cut:
            self._runs, self._cut, sampler.stages = [], False, 0
        done, of_all = len(self._runs), self.limits.deadline
        last = deadline is None or (of_all is not None and of_all <= deadline)
        sampler.limits = self.limits if last else replace(self.limits, deadline=deadline)
        run, stop = sampler.next_run(done, publisher.after_stage)
        if stop == StopReason.BUDGET and not last:
            self._cut, stop = run is not None, None
        if run is not None:
            self._runs.append(run)
            self.answer = publisher.publish_cut(self._runs) if self._cut else publisher.publish_runs(self._runs)
            self._log.append(publisher.log_line(len(self._runs), self.answer))
        assert self.answer is not None
        if stop is None and not self._cut and len(self._runs) < self._wanted:
            stop = sampler.limit_reached() if last else None
            if stop is None and run is not None:  # better ones follow
                publisher.hand_out(replace(self.answer, result=StopReason.UNDERWAY))
        if stop is not None or (len(self._runs) >= self._wanted and not self._cut):
            self._end(self.answer, stop)
        return run is not None

    def _end(self, answer: Hypotheses, stop: StopReason | None = None) -> None:
        if stop is not None and len(self._runs) < self._wanted:
            self._log.append(f"no room for more ({stop})")
            answer = replace(answer, result=stop, stage=self._sampler.stages)
            self._runs[-1] = replace(self._runs[-1], result=stop)
        self.answer, self.done = answer, True
        self._publisher.hand_out(answer)

    def stop(self, reason: StopReason) -> None:
        """Make the present answer the last one."""
        if not self.done and self.answer is not None:
            if self._runs:
                self._runs[-1] = replace(self._runs[-1], result=reason)
            self._log.append(f"no room for more ({reason})")
            self.answer, self.done = replace(self.answer, result=reason), True
            self._publisher.hand_out(self.answer)

    def estimate(self) -> Estimate:
        """The present answer and its sources. There must be one."""
        assert self.answer is not None
        runs = self._runs or [replace(self._sampler.guess(), result=self.answer.result)]
        return Estimate(
            hypotheses=self.answer,
            posterior=pooled(runs, self._sampler.smc.evidence_power),
            likelihood=self._sampler.likelihood,
            observation=self.view.observation,
            object_frame=self.view.object_frame,
            seconds=self._seconds,
            log=tuple(self._log),
            parts=self._sampler.stopwatch.seconds,
            start=self._sampler.start,
        )

    @contextmanager
    def _counted(self) -> Iterator[None]:
        begun = time.monotonic()
        try:
            yield
        finally:
            self._seconds += time.monotonic() - begun


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

    def publish_cut(self, runs: list[Posterior]) -> Hypotheses:
        """The answer of a run that a step's deadline ended: as many shapes, as coarse as early ones."""
        power, config = self.sampler.smc.evidence_power, self.config
        return self._published(pooled(runs, power), replace(config, coarse=config.first_coarse), power, early=True)

    def publish_draws(self, draws: Posterior) -> Hypotheses:
        """The answer of weighed draws, whose weights are those of the posterior."""
        return self._published(draws, self.config, 1.0)

    def hand_out(self, answer: Hypotheses) -> None:
        """Pass an answer on, if anyone listens."""
        if self.callbacks.on_answer is not None:
            self.callbacks.on_answer(answer)

    @property
    def wants_guess(self) -> bool:
        """Whether the callbacks want a guess."""
        return self.callbacks.on_answer is not None and self.callbacks.guess

    def hand_out_guess(self) -> Hypotheses:
        """Publish the network's or the encoder's guess."""
        return self._hand_out_early(self.sampler.guess())

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

    def log_line(self, runs: int, answer: Hypotheses) -> str:
        """A log line: the findings of so many runs."""
        loss, smc = answer.diagnostics.expected_loss, self.sampler.smc
        line = f"{runs * smc.populations} x {smc.particles} particles: "
        line += f"expected loss {loss:.4f} nats" if np.isfinite(loss) else "expected loss not known"
        line += f", {100 * (1.0 - answer.diagnostics.explained):.0f}% of pixels not explained"
        return line + (f", populations that failed and are left out: {answer.failed}" if answer.failed else "")

    def _hand_out_early(self, posterior: Posterior) -> Hypotheses:
        """An answer that is cheaper to make."""
        begun, config = time.monotonic(), self.config
        cheaper = replace(config, hypotheses=config.first_hypotheses, coarse=config.first_coarse)
        answer = self._published(posterior, cheaper, self.sampler.smc.evidence_power, early=True)
        self.hand_out(answer)
        self._early_at = time.monotonic()
        self._early_s = self._early_at - begun
        return answer

    def _published(
        self,
        posterior: Posterior,
        config: PublishConfig,
        evidence_power: float,
        guess: Posterior | None = None,
        early: bool = False,
    ) -> Hypotheses:
        sampler = self.sampler
        with sampler.stopwatch.part("publishing"):
            h = published(
                sampler.view, posterior, sampler.likelihood, sampler.prior, config, sampler.seed,
                point_gradients=sampler.point_gradients, evidence_power=evidence_power, guess=guess, early=early,
            )  # fmt: skip
        return replace(h, stage=max(sampler.stages, h.stage), kinds=sampler.kinds)
