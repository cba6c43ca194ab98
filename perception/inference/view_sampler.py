"""Independent runs of the sampler on one view: where they begin, and what they cost."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import RLock

import jax
import numpy as np
from jaxtyping import Array

from perception.inference.limits import Limits
from perception.inference.publish import ConditionedView
from perception.inference.stopwatch import Stopwatch
from perception.observation.encoder_crop import crop
from probnerf.inference import asks_encoder, crossings_of, encoder_guess, infer, likelihood_of, modes_of, sampler_of
from probnerf.likelihood.settings import Likelihood
from probnerf.network_start import defensive, network_guess, network_used, picture_density, weigh_draws
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import ProbNeRF
from probnerf.prior.posterior_flow import PictureDensity
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.sampling.hmc import Reference, StageInfo
from probnerf.sampling.importance import WeighedDraws
from probnerf.settings import InferConfig, TemperedSMCConfig
from probnerf.types import KINDS, Posterior, StopReason

# Two batches of eigenvalues may wait for each other for ever: each holds a thread of XLA's pool, one per core, until
_ONE_AT_A_TIME = RLock()  # another thread of that pool has done its parts (jaxlib's ParallelBatchMap)


@dataclass(eq=False)
class ViewSampler:
    """Makes runs of the sampler on one view, which begin at the same place, and counts what they cost together.

    That place is `before`, a posterior of the same view that was cut short; or the draws of the prior's posterior
    network; or, if it has none, the modes that `climb` finds; or else the prior.
    """

    view: ConditionedView
    prior: Prior
    config: InferConfig  # of one run
    seed: int
    limits: Limits  # of all runs together
    before: Posterior | None = None
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    stages: int = 0  # done
    point_gradients: float = 0.0  # field evaluations with gradient
    _reference: Reference | None = None  # where all runs begin, if not at the prior
    _stage_s: list[float] = field(default_factory=list)  # s; each stage of the latest run

    @cached_property
    def likelihood(self) -> Likelihood:
        """Of the view."""
        return likelihood_of(self.config, self.view.every_choice, not self.view.pose_known)

    @property
    def smc(self) -> TemperedSMCConfig:
        """Of one run of tempered SMC."""
        return sampler_of(self.config, self._reference, self.before)

    @property
    def start(self) -> str:
        """Where sampling begins, in words."""
        if self.before is not None:
            return "the samples of an earlier run"
        if self._reference is None:
            return "the prior"
        return "the network's draws" if self.asks_network else "the encoder's modes"

    @property
    def asks_network(self) -> bool:
        """Whether a posterior network tells where to begin."""
        return self._tempers_anew and self._density is not None

    @property
    def asks_encoder(self) -> bool:
        """Whether an encoder can guess where the object's modes are, and no network does."""
        return (
            self._tempers_anew and not self.asks_network and asks_encoder(self.config, self.prior.model, self._picture)
        )

    @property
    def _tempers_anew(self) -> bool:
        return self.config.method == "tempered_smc" and self.before is None

    @cached_property
    def _density(self) -> PictureDensity | None:
        """The posterior network's density for the view; of several views, for the newest one."""
        network = network_used(self.config, self.prior)
        if network is None:
            return None
        view = self.view
        with self.stopwatch.part("network"):
            picture = crop(view.frame, view.segment, view.object_frame, network.sizes.image_size)
            return picture_density(network, picture, view.observation, not view.pose_known)

    @cached_property
    def _picture(self) -> EncoderPicture | None:
        """The encoder's input. It is None without ranges, which the encoder was trained with, and if the pose is known
        (guesses at one yaw climb to poor modes). Then sampling begins at the prior.
        """
        view, model = self.view, self.prior.model
        if view.pose_known or view.frame.depth is None or not isinstance(model, ProbNeRF):
            return None
        return crop(view.frame, view.segment, view.object_frame, model.preset.image_size)

    @cached_property
    def kinds(self) -> dict[str, float]:
        """What kind of thing it is: the network's probabilities, by name; empty if there is no network."""
        if self._density is None:
            return {}
        p = np.exp(np.asarray(self._density.features.log_kinds, np.float64))
        return dict(zip(KINDS, (p / p.sum()).tolist(), strict=True))

    @property
    def _key(self) -> Array:
        return jax.random.key(self.seed)

    def guess(self) -> Posterior:
        """The network's answer without sampling, or the encoder's. Requires `asks_network` or `asks_encoder`."""
        key = jax.random.fold_in(self._key, 1)
        if self.asks_network:
            assert self._density is not None
            with self.stopwatch.part("network"):
                return network_guess(key, self._density, self.config.network.guess)
        assert isinstance(self.prior.model, ProbNeRF) and self._picture is not None
        with self.stopwatch.part("climbing"):
            return encoder_guess(key, self.prior.model, self.likelihood, self.view.observation, self._picture)

    def weigh(self) -> WeighedDraws | None:
        """Have all runs begin at the network's draws, and weigh some of these. None if none may be weighed.

        A run draws its own: those that were weighed are known to be poor, and would bias its evidence.
        """
        assert self._density is not None
        settings, key = self.config.network, jax.random.fold_in(self._key, 2)
        self._reference = mixture = defensive(self._density, settings)
        if settings.most < settings.chunk:
            return None
        with self.stopwatch.part("network"):
            return weigh_draws(
                key, self.prior, self.likelihood, self.view.observation, mixture, settings, self.limits.deadline
            )

    def climb(self) -> None:
        """Have all runs begin at the modes that the encoder's guesses climb to."""
        model, observation, key = self.prior.model, self.view.observation, jax.random.fold_in(self._key, 1)
        with _ONE_AT_A_TIME, self.stopwatch.part("climbing"):
            self._reference = jax.block_until_ready(modes_of(key, model, observation, self.config, self._picture))
        climbed = self.config.modes.gradients(self.likelihood.dim(model))
        self.point_gradients += climbed * crossings_of(self.likelihood, observation)

    def next_run(
        self, number: int, on_stage: Callable[[StageInfo], bool | None]
    ) -> tuple[Posterior | None, StopReason | None]:
        """Run of this number, and the reason if it ended early, else None.

        A run that was cut short is left out, except the very first, which is better than none.
        """
        limit = self.limit_reached() if number > 0 else None
        if limit is not None:
            return None, limit
        run = self.run(number, on_stage)
        whole = run.result == StopReason.CONVERGED
        return run if whole or number == 0 else None, None if whole else run.result

    def run(self, number: int, on_stage: Callable[[StageInfo], bool | None]) -> Posterior:
        """One run, with its own random numbers; other threads' runs wait. `on_stage` gets the stages of all runs."""
        self._stage_s = []
        stages = None if self.limits.stages is None else self.limits.stages - self.stages
        since = 0.0

        def after_stage(info: StageInfo) -> bool | None:
            nonlocal since
            self._stage_s.append(time.monotonic() - since)
            ends = on_stage(replace(info, stage=self.stages + info.stage))
            since = time.monotonic()
            return ends

        with _ONE_AT_A_TIME, self.stopwatch.part("sampling"):
            since = time.monotonic()
            posterior, _ = infer(
                jax.random.fold_in(self._key, 10 + number) if number else self._key,
                self.prior.model,
                self.view.every_choice,
                self.config,
                reference=self._reference,
                before=self.before,
                sample_pose=not self.view.pose_known,
                on_stage=after_stage,
                deadline=self.limits.deadline,
                stages=stages,
            )
        self.stages += int(posterior.diagnostics.stages)
        crossings = crossings_of(self.likelihood, self.view.every_choice)
        self.point_gradients += float(posterior.diagnostics.point_gradients) * crossings
        return posterior

    def limit_reached(self) -> StopReason | None:
        """Which limit leaves no room for a next run, if one does. It takes as long as the one before, or so: as many
        stages, and each as long as the shortest.
        """
        return self.limits.reached(self.stages, time.monotonic(), len(self._stage_s) * min(self._stage_s, default=0.0))
