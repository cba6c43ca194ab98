"""How much model a scene needs: from a frame's segment to published hypotheses, with no more than that.

A run is a small sampler: a few independent populations of a few particles, which begin where climbs from the encoder's
guesses end. How far its populations disagree of unseen space tells what score their small number is expected to lose
there (`publish.expected_loss`). Where that is above the tolerance the controller makes as many further runs as should
bring it down (it falls with their number), and their populations answer together; where the shapes leave too many
pixels unexplained (a posterior-predictive check) it makes all it may. There is an answer to publish from the start, and
a better one after each step.

Lattice and rays are the same for every scene: with half of both, shapes were worse on easy scenes as on hard ones, and
no check told where (`farside bench frontier` has a coarse lattice among its levers).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import RLock

import jax
import numpy as np
from jaxtyping import Array

from perception.answers.hypotheses import Hypotheses
from perception.inference.publish import ConditionedView, published
from perception.inference.settings import ControllerConfig
from perception.observation.encoder_crop import crop
from perception.observation.object_frame import ObjectFrame
from perception.observation.rays import observe
from perception.observation.segmentation import Segment
from perception.observation.visibility import seen_voxels
from perception.sources.frame import Frame
from probnerf.inference import asks_encoder, crossings_of, encoder_guess, infer, likelihood_of, modes_of, sampler_of
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import ProbNeRF
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.sampling.hmc import StageInfo
from probnerf.sampling.populations import pooled
from probnerf.settings import TemperedSMCConfig
from probnerf.types import Observation, Posterior

# Two batches of eigenvalues may wait for each other for ever: each holds a thread of XLA's pool, one per core, until
_ONE_AT_A_TIME = RLock()  # another thread of that pool has done its parts (jaxlib's ParallelBatchMap)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Everything known of one object: what is published, and what it was made from."""

    hypotheses: Hypotheses
    posterior: Posterior
    likelihood: Likelihood
    observation: Observation
    object_frame: ObjectFrame
    seconds: float
    log: tuple[str, ...] = ()  # why there were more runs, and why no more, a line an answer
    parts: dict[str, float] = field(default_factory=dict)  # s; of them: climbing, sampling, publishing


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
    """Hypotheses about one object of a frame; first ones, of fewer shapes, go to `on_answer` while it works.

    With `stages` and no budget the answer is a function of the inputs alone. `known` is the object's own cube where its
    pose is known already (the handle at +x), so that only its shape is inferred.

    Raises ValueError where the segment cannot be observed (too small, outside the prior's range of sizes).
    """
    config = config or ControllerConfig()
    begun = time.monotonic()
    observation, cube = observe(frame, segment, config.observe, seed, known)
    view = ConditionedView(frame, segment, observation, cube, seen_voxels(frame, segment, cube, config.grid))
    return infer_view(
        view,
        prior,
        config,
        seed=seed,
        pose_known=known is not None,
        deadline=None if budget_s is None else begun + budget_s,
        stages=stages,
        on_stage=on_stage,
        on_answer=on_answer,
    )


def infer_view(
    view: ConditionedView,
    prior: Prior,
    config: ControllerConfig,
    *,
    seed: int = 0,
    pose_known: bool = False,
    before: Posterior | None = None,
    fresh: bool = True,
    deadline: float | None = None,
    stages: int | None = None,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    on_answer: Callable[[Hypotheses], None] | None = None,
) -> Estimate:
    """Sample the posterior of a view and publish it, in as many runs as it takes.

    `before` is a posterior of the same view that was cut short; one run goes on from it. `fresh`: nothing is known of
    the object, so that the encoder's guess is worth handing out at once. `stages` and `deadline` are for all runs
    together. A further run that is cut short is left out.
    """
    begun = time.monotonic()
    work = _Work(view, prior, config, seed, pose_known, before, fresh, deadline, stages, on_stage, on_answer)
    grows = before is None and config.infer.method == "tempered_smc"
    runs: list[Posterior] = []  # whole ones, but for a first
    log: list[str] = []
    needed, answered = 1, 0
    short: str | None = None
    while short is None and len(runs) < needed:
        posterior = work.sample(len(runs))
        whole = posterior.result == "converged"
        if whole or not runs:
            runs.append(posterior)
        if not whole:
            short = posterior.result
        elif len(runs) < needed:
            short = work.short_of()
        if short is None and len(runs) < needed:
            continue
        if len(runs) > answered:
            h = work.answer = work.publish(pooled(runs, work.smc.evidence_power), config.hypotheses)
            answered, missed = len(runs), 1.0 - h.diagnostics["explained"]
            loss = h.diagnostics["expected_loss"]
            told = f"expected loss {loss:.4f} nats" if np.isfinite(loss) else "expected loss not known"
            told += f", {100 * missed:.0f}% of pixels not explained"
            if h.failed:
                told += f", populations that failed and are left out: {h.failed}"
            log.append(f"{work.amount(answered)}: {told}")
            if grows and short is None:
                needed = config.needed(answered, loss, missed)
            if short is None and needed > answered:
                log[-1] += f" -> {work.amount(needed)}"
                short = work.short_of()
                if short is None and on_answer is not None:
                    on_answer(replace(h, result="underway"))
        if short is not None and len(runs) < needed:
            log.append(f"no room for more ({short})")
            work.answer, runs[-1] = replace(h, result=short, stage=work.stages), replace(runs[-1], result=short)
    assert work.answer is not None
    if on_answer is not None:
        on_answer(work.answer)
    found = pooled(runs, work.smc.evidence_power)
    seconds = time.monotonic() - begun
    work.turn_to("")
    return Estimate(
        work.answer, found, work.likelihood, view.observation, view.object_frame, seconds, tuple(log), work.parts
    )


@dataclass(eq=False)
class _Work:
    """One view's sampling: what all runs share, and what they have cost."""

    view: ConditionedView
    prior: Prior
    config: ControllerConfig
    seed: int
    pose_known: bool
    before: Posterior | None
    fresh: bool
    deadline: float | None
    cap: int | None  # stages
    on_stage: Callable[[StageInfo], bool | None] | None
    on_answer: Callable[[Hypotheses], None] | None
    searched: bool = False
    reference: GaussianMixture | None = None  # where all runs begin, if not at the prior
    stages: int = 0  # done
    point_gradients: float = 0.0
    answer: Hypotheses | None = None  # of whole runs
    answered: float = field(default_factory=time.monotonic)  # when the last one that was underway was given,
    answering: float = 0.0  # s; and what it took
    stage_s: list[float] = field(default_factory=list)  # s; each stage of the latest run
    since: float = 0.0  # when the stage at hand began
    parts: dict[str, float] = field(default_factory=dict)  # s; by what was done
    part: str = ""  # what is being done
    turned: float = field(default_factory=time.monotonic)  # since when

    @cached_property
    def likelihood(self) -> Likelihood:
        return likelihood_of(self.config.infer, self.view.observation, not self.pose_known)

    @property
    def smc(self) -> TemperedSMCConfig:
        """Of one run."""
        return sampler_of(self.config.infer, self.reference, self.before)

    @cached_property
    def picture(self) -> EncoderPicture | None:
        """What the encoder sees. Without the ranges that it was trained with there is none, nor where the pose is known
        (guesses at one yaw climb to poor modes): sampling begins at the prior.
        """
        if self.pose_known or self.view.frame.depth is None or not isinstance(self.prior.model, ProbNeRF):
            return None
        return crop(self.view.frame, self.view.segment, self.view.object_frame, self.prior.model.preset.image_size)

    def turn_to(self, part: str) -> None:
        """What time goes to from now on; "": nothing that is counted."""
        now = time.monotonic()
        if self.part:
            self.parts[self.part] = self.parts.get(self.part, 0.0) + now - self.turned
        self.part, self.turned = part, now

    def sample(self, run: int) -> Posterior:
        """One run of `infer`; other threads' wait."""
        with _ONE_AT_A_TIME:
            return self._sampled(run)

    def _sampled(self, run: int) -> Posterior:
        observation = self.view.observation
        key = jax.random.key(self.seed)
        self.turn_to("climbing")
        if not self.searched and self.before is None:
            self._search(jax.random.fold_in(key, 1))
        self.turn_to("sampling")
        self.stage_s, self.since = [], time.monotonic()
        posterior, likelihood = infer(
            jax.random.fold_in(key, 10 + run) if run else key,
            self.prior.model,
            observation,
            self.config.infer,
            reference=self.reference,
            before=self.before,
            sample_pose=not self.pose_known,
            on_stage=self._told,
            deadline=self.deadline,
            stages=None if self.cap is None else self.cap - self.stages,
        )
        self.turn_to("")
        self.stages += int(posterior.diagnostics.stages)
        self.point_gradients += float(posterior.diagnostics.point_gradients) * crossings_of(likelihood, observation)
        return posterior

    def _search(self, key: Array) -> None:
        """Ask the encoder, hand out what it says where nothing better is known, and climb from there: once a view."""
        self.searched, config, model = True, self.config.infer, self.prior.model
        if config.method != "tempered_smc" or not asks_encoder(config, model, self.picture):
            return
        assert isinstance(model, ProbNeRF) and self.picture is not None
        if self.on_answer is not None and self.fresh:
            self._answer(encoder_guess(key, model, self.likelihood, self.view.observation, self.picture))
        self.reference = jax.block_until_ready(modes_of(key, model, self.view.observation, config, self.picture))
        climbed = config.modes.gradients(self.likelihood.dim(model))
        self.point_gradients += climbed * crossings_of(self.likelihood, self.view.observation)

    def _told(self, info: StageInfo) -> bool | None:
        if self.on_stage is not None and self.on_stage(replace(info, stage=self.stages + info.stage)):
            return True
        now = time.monotonic()
        self.stage_s.append(now - self.since)
        # without an encoder's guess the first answer at once; a later one when the time it takes is a tenth of what
        # went by; none that is underway once a run is whole
        if self.on_answer is not None and self.answer is None and now - self.answered >= 9.0 * self.answering:
            self._answer(info.samples())
        self.since = time.monotonic()
        return None

    def _answer(self, posterior: Posterior) -> None:
        """Hand out what there is so far, from fewer shapes."""
        assert self.on_answer is not None
        begun = time.monotonic()
        self.on_answer(self.publish(posterior, self.config.first_hypotheses))
        self.answered = time.monotonic()
        self.answering = self.answered - begun

    def publish(self, posterior: Posterior, count: int) -> Hypotheses:
        """The samples at hand as planners read them."""
        before = self.part
        self.turn_to("publishing")
        more = {"point_gradients": self.point_gradients, "evidence_power": self.smc.evidence_power}
        config = replace(self.config, hypotheses=count)
        h = published(self.view, posterior, self.likelihood, self.prior, config, self.seed, more)
        self.turn_to(before)
        return replace(h, stage=max(self.stages, h.stage))

    def short_of(self) -> str | None:
        """Which limit leaves no room for a next run, if one does: it takes the time of the run before, at least."""
        if self.cap is not None and self.stages >= self.cap:
            return "stages"
        expected = len(self.stage_s) * min(self.stage_s)
        if self.deadline is not None and time.monotonic() + expected > self.deadline:
            return "budget"
        return None

    def amount(self, runs: int) -> str:
        """The particles of so many runs, in words."""
        return f"{runs * self.smc.populations} x {self.smc.particles} particles"
