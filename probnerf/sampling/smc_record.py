"""The record of the stages of tempered SMC: the current particles, samples with their diagnostics, and counts."""

import time
from dataclasses import dataclass, field

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from probnerf.sampling.hmc import HMCState, Metric, StageInfo
from probnerf.sampling.populations import gathered
from probnerf.settings import TemperedSMCConfig
from probnerf.types import Posterior, StopReason


class SMCState(eqx.Module):
    """m populations of p particles, resampled for the target at beta but not yet moved there."""

    chain: HMCState
    beta: Float[Array, "m"]
    log_evidence: Float[Array, "m"]  # of the target at beta
    variance: Float[Array, "m"]  # of log_evidence, assuming independent particles: sum of 1 / ESS - 1 / size
    ancestor: Int[Array, "m p"]  # index of the initial particle
    step_size: Float[Array, "m 2"]  # of the even and the odd particles; each is tuned on the other half
    metric: Metric  # with a leading axis m
    moved: Float[Array, "m"]  # mean number of accepted moves per particle since beta last increased


class StageStats(eqx.Module):
    """The statistics of a stage, per population."""

    ess: Float[Array, "m"]  # effective sample size of the resampling weights (NaN: no resampling)
    acceptance: Float[Array, "m"]  # mean over the stage
    step_size: Float[Array, "m"]  # the last one used
    divergences: Int[Array, ""]


@dataclass(eq=False)
class SMCRecord:
    """The record of the stages so far: the current state, the pools of samples, and counts."""

    config: TemperedSMCConfig
    state: SMCState
    stats: StageStats  # of the last stage, or of the start
    begun: float  # on time.monotonic()'s clock
    pools: list[HMCState] = field(default_factory=list)  # of the final stages
    stages: int = 0
    divergences: int = 0
    acceptance: float = float("nan")  # mean over the last stage
    shortest_s: float = float("inf")  # shortest stage, except the first, which may compile

    @property
    def complete(self) -> bool:
        """Whether all final stages are complete."""
        return len(self.pools) == self.config.final_stages

    @property
    def gradients(self) -> float:
        """Gradient evaluations of whole positions: once per particle chosen at the start, then in every stage."""
        each = self.config.moves * self.config.leapfrog_steps
        return float(self.config.populations * self.config.particles * (1 + self.stages * each))

    def limit_reached(self, cap: int, deadline: float | None) -> StopReason | None:
        """The limit that forbids another stage, or None.

        It is the number of stages, or the deadline if the shortest stage so far would pass it.
        """
        if self.stages >= cap:
            return StopReason.STAGES
        expected = self.shortest_s if self.stages > 1 else 0.0
        if deadline is not None and time.monotonic() + expected > deadline:
            return StopReason.BUDGET
        return None

    def add(self, state: SMCState, stats: StageStats, pool: HMCState, begun: float) -> None:
        """Add a completed stage. `begun` is its start time."""
        acceptance = float(np.mean(np.asarray(stats.acceptance)))  # waits for the device
        if bool(np.all(np.asarray(self.state.beta) == 1.0)):
            self.pools = [*self.pools, pool]
        self.state, self.stats, self.acceptance = state, stats, acceptance
        self.stages += 1
        self.divergences += int(stats.divergences)
        if self.stages > 1:
            self.shortest_s = min(self.shortest_s, time.monotonic() - begun)

    def stage_info(self) -> StageInfo:
        """The last stage, or the start, in the form that callbacks receive."""

        def row(a: Array) -> tuple[float, ...]:
            return tuple(np.asarray(a).tolist())

        return StageInfo(
            stage=self.stages,
            beta=row(self.state.beta),
            ess=row(self.stats.ess),
            acceptance=row(self.stats.acceptance),
            step_size=row(self.stats.step_size),
            log_evidence=row(self.state.log_evidence),
            divergences=self.divergences,
            seconds=time.monotonic() - self.begun,
            samples=self.posterior,
        )

    def posterior(self, result: StopReason = StopReason.UNDERWAY) -> Posterior:
        """The pools of the last `keep` stages as samples with diagnostics. If there is no pool yet, the particles."""
        state, ancestors = self.state, np.asarray(self.state.ancestor)
        diagnostics = {
            "acceptance": jax.device_put(np.float32(self.acceptance)),
            "divergences": jax.device_put(np.int32(self.divergences)),
            "ancestors": jax.device_put(np.int32(sum(len(np.unique(row)) for row in ancestors))),
            "stages": jax.device_put(np.int32(self.stages)),
            "point_gradients": jax.device_put(np.float32(self.gradients)),
        }
        beta, evidence, variance = (np.asarray(a, np.float64) for a in (state.beta, state.log_evidence, state.variance))
        pools = (self.pools or [state.chain])[-self.config.keep :]
        return gathered(pools, beta, evidence, variance, self.config.evidence_power, diagnostics, result)
