"""Settings of inference: samplers, where they start, and the pixel likelihood. Standard library only, for the command
line reads them without JAX."""

import math
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class AdamConfig:
    """Adam with a cosine schedule; rates are in units of the latents' prior standard deviation."""

    steps: int = 300
    learning_rate: float = 0.05
    final_learning_rate: float = 0.002

    def __post_init__(self) -> None:
        if self.steps < 1 or not 0 < self.final_learning_rate <= self.learning_rate:
            raise ValueError(
                f"steps {self.steps} must be 1 or more, and the learning rate may only fall,"
                f" from {self.learning_rate:g} to {self.final_learning_rate:g}"
            )


@dataclass(frozen=True)
class ModesConfig:
    """How many starts climb how far, and what is laid about where they end."""

    starts: int = 24  # at even yaws (where the pose is known: draws)
    screen: AdamConfig = field(default_factory=lambda: AdamConfig(steps=30, final_learning_rate=0.05))  # of all starts
    climb: AdamConfig = field(default_factory=lambda: AdamConfig(steps=30))  # of the better one of each two neighbours
    difference: float = 0.03  # of positions, for second derivatives
    widen: float = 2.0  # factor on the likelihood's variances: weights of a reference that is too narrow run away
    power: float = 0.5  # a Gaussian's share is its mode's evidence (Laplace) to this power
    prior_share: float = 0.1
    unknown: float = 0.15  # share of the encoder's picture that says nothing above which it is not asked (`modes_of`)

    def gradients(self, dim: int) -> float:
        """Gradients of whole positions of `dim` numbers that climbs and second derivatives take."""
        return float(self.starts * self.screen.steps + self.starts // 2 * (self.climb.steps + 1 + dim))

    def __post_init__(self) -> None:
        good = min(self.difference, self.widen, self.prior_share) > 0 and self.prior_share < 1
        if self.starts < 2 or self.starts % 2 or not (good and 0 <= self.power <= 1):
            raise ValueError(
                f"starts {self.starts} must be even and 2 or more, difference {self.difference:g} and widen"
                f" {self.widen:g} more than 0, power {self.power:g} from 0 to 1, prior_share {self.prior_share:g}"
                " between 0 and 1"
            )


@dataclass(frozen=True)
class NetworkConfig:
    """What is done with the draws of a posterior network, and when their importance weights are answer enough."""

    guess: int = 128  # draws that are the first answer
    prior_share: float = 0.1  # of the mixture that weighed draws and tempering begin from
    chunk: int = 256  # draws weighed at a time ...
    most: int = 4096  # ... and in all; fewer than a chunk: none are weighed
    enough_ess: float = 200.0
    largest_k: float = 0.7  # of the weights' tail (`sampling.pareto_tail`)
    apart: float = 0.5  # nats; largest difference of the two halves' log-evidences

    def __post_init__(self) -> None:
        if self.guess < 1 or not 0 < self.prior_share < 1 or not min(self.enough_ess, self.apart) > 0:
            raise ValueError(
                f"guess {self.guess} must be 1 or more, prior_share {self.prior_share:g} between 0 and 1,"
                f" and enough_ess {self.enough_ess:g} and apart {self.apart:g} more than 0"
            )
        if self.chunk < 64 or self.chunk % 64 or self.most < 0:
            raise ValueError(f"chunk {self.chunk} must be a multiple of 64, and most {self.most} 0 or more")


@dataclass(frozen=True)
class TemperedSMCConfig:
    """Sizes and targets; all are compiled in."""

    populations: int = 2  # independent runs: their spread is the Monte Carlo error
    particles: int = 64  # per population; populations * particles positions are evaluated at a time
    start_particles: int = 256  # drawn from the reference per population for the first importance step
    ess_target: float = 0.5  # effective sample size kept by each step of beta, as a fraction of the pool
    moves: int = 4  # HMC iterations a stage: a population's pool has moves * particles states
    leapfrog_steps: int = 4
    target_acceptance: float = 0.8
    least_moved: float = 0.3  # accepted moves of a particle, on average, without which beta waits
    final_stages: int = 2  # at beta = 1
    keep: int = 2  # the last of them, whose pools become the samples
    max_stages: int = 200
    evidence_power: float = 1.0  # a population's share of the weight is its evidence estimate to this power
    metric: bool = True  # read off the population; without, the prior's

    def __post_init__(self) -> None:
        if min(self.populations, self.moves, self.leapfrog_steps, self.max_stages) < 1 or self.particles < 2:
            raise ValueError("TemperedSMCConfig: counts must be positive, and particles at least 2")
        if self.start_particles < self.particles:
            raise ValueError(
                f"TemperedSMCConfig: start_particles {self.start_particles} must be at least particles {self.particles}"
            )
        if not (0 < self.ess_target < 1 and 0 < self.target_acceptance < 1 and 0 <= self.evidence_power <= 1):
            raise ValueError("TemperedSMCConfig: ess_target, target_acceptance and evidence_power: between 0 and 1")
        if not 1 <= self.keep <= self.final_stages:
            raise ValueError(
                f"TemperedSMCConfig: keep {self.keep} must lie between 1 and final_stages {self.final_stages}"
            )

    @property
    def longest_step(self) -> float:
        """A quarter turn a trajectory: under the right metric all periods are 2 pi, and more undoes itself."""
        return 0.5 * math.pi / self.leapfrog_steps


@dataclass(frozen=True)
class AnnealedHMCConfig:
    """The paper's schedule. It names neither start nor base step: chains start at the prior, the step is tuned."""

    chains: int = 8
    iterations: int = 100
    leapfrog_steps: int = 100
    s_start: float = 5.0  # observation noise scale at the first iteration ...
    s_end: float = 0.1  # ... and at the last: the scale that the log-likelihood was written for
    keep: int = 16  # last states of each chain that become samples
    step_per_scale: float = 0.05  # step size divided by s_t
    tune_iterations: int = 20  # over these, step_per_scale follows the acceptance; then it is fixed (0: never tuned)
    target_acceptance: float = 0.8

    def __post_init__(self) -> None:
        if not (self.chains >= 1 and self.leapfrog_steps >= 1 and self.step_per_scale > 0):
            raise ValueError("AnnealedHMCConfig: chains, leapfrog_steps and step_per_scale must be positive")
        if not 1 <= self.keep <= self.iterations:
            raise ValueError(f"AnnealedHMCConfig: keep {self.keep} must lie between 1 and iterations {self.iterations}")
        if not 0 < self.s_end <= self.s_start:
            raise ValueError(f"AnnealedHMCConfig: need 0 < s_end <= s_start, got {self.s_end} and {self.s_start}")


Method = Literal["tempered_smc", "annealed_hmc"]


def quick_smc(populations: int, particles: int) -> TemperedSMCConfig:
    """What two CPU cores move in seconds; `TemperedSMCConfig()` is the one that the laws are tested on.

    Populations count alike: what decides between modes, a few nats, is less than the likelihood's own error and the
    error of the evidence's estimates.
    """
    return TemperedSMCConfig(
        populations=populations,
        particles=particles,
        start_particles=8 * particles,
        moves=1,
        leapfrog_steps=3,
        ess_target=0.4,
        target_acceptance=0.65,
        final_stages=1,
        keep=1,
        evidence_power=0.0,
        least_moved=1.0,
    )


@dataclass(frozen=True)
class InferConfig:
    """Which sampler, how much of it, and the pixel likelihood's numbers."""

    method: Method = "tempered_smc"
    modes: ModesConfig = field(default_factory=ModesConfig)  # where tempered_smc begins
    # From modes each of many small populations follows one or two to the end. From the prior few particles all descend
    # from one or two starts, and lose the other modes.
    smc: TemperedSMCConfig = field(default_factory=lambda: quick_smc(8, 8))
    smc_from_prior: TemperedSMCConfig = field(default_factory=lambda: quick_smc(4, 48))
    network: NetworkConfig = field(default_factory=NetworkConfig)
    smc_from_network: TemperedSMCConfig = field(default_factory=lambda: quick_smc(8, 8))
    hmc: AnnealedHMCConfig = field(default_factory=AnnealedHMCConfig)
    lattice: int = 32  # G: cubes per 2 units
    extent: float = 1.1  # the lattice covers [-extent, extent]^3: an object may be larger than its guessed cube
    below: float = 0.15  # and so much under the plane, for its height is uncertain
    colour_sigma: float = 0.3  # s: what the prior cannot draw of a print or a band, too
    wall_sigma: float = 0.05  # cube units: the model's own error in a wall's place; wide, for small misfits are shared
    outlier: float = 0.01  # share of ranges from nowhere; small, for a lid over a visible cavity is no outlier
    reach: float = 0.3  # cube units behind a measured range beyond which nothing is asked
    # kappa: what one ray counts for, which stands for many pixels; with 1 validation objects' answers were too cautious
    power: float = 2.0
    encoder_starts: bool = True  # begin at the modes that the encoder's guesses climb to; otherwise at the prior
    network_starts: bool = True  # begin at the draws of the prior's posterior network, if it has one
    sample_delta: bool = False  # also infer the weights' perturbation delta

    def __post_init__(self) -> None:
        if self.lattice < 1 or not min(self.extent, self.colour_sigma, self.wall_sigma, self.power) > 0:
            raise ValueError(
                f"lattice {self.lattice} must be 1 or more, and extent {self.extent:g}, colour_sigma"
                f" {self.colour_sigma:g}, wall_sigma {self.wall_sigma:g} and power {self.power:g} more than 0"
            )
