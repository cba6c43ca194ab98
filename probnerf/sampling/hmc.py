"""Hamiltonian Monte Carlo for standard-normal latents.

Symbols: q position [..., D]; v whitened momentum [..., D] ~ N(0, I); l log-likelihood; beta inverse temperature; r the
reference density at beta = 0; g = log r - log N(0, I). Unless r is given, it is the prior, and g = 0.
Target: r(q)^(1 - beta) (N(q; 0, I) exp(l(q)))^beta = N(q; 0, I) exp(f(q)) with f = (1 - beta) g + beta l. With mass
matrix M and Omega = M^(-1/2), v = Omega p, Hamilton's equations are

    dq/dt = Omega v,    dv/dt = -Omega q + Omega grad f(q),    H = (|q|^2 + |v|^2) / 2 - f(q).

Without f, each eigenvector of Omega is a harmonic oscillator of frequency omega. Its exact solution rotates (q, v) by
the angle omega t. The split integrator (half kick, rotation, half kick; Shahbaba et al. 2014) has errors only from f.
So directions that f does not depend on do not limit the step size.

All chains run as one batch. Nothing compiles per chain, and nothing logs inside jit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from probnerf.types import Posterior

# (args, q [p, d]) -> log-likelihood [p]; differentiable, rows independent. It is a static argument of the compiled
# functions. To avoid compiling again, pass the same function object (not a new lambda) and change only `args`.
LogLikelihood = Callable[[Any, Float[Array, "p d"]], Float[Array, "p"]]


class Reference(Protocol):
    """A density to start from. It is a PyTree, so another one of the same shapes needs no compilation."""

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        ...

    def over_prior(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """g = log r(q) - log N(q; 0, I); finite everywhere, differentiable."""
        ...


MAX_ENERGY_ERROR = 1000.0  # nats; beyond it a trajectory counts as divergent
JITTER = (0.8, 1.2)  # range of a random factor of the step size; it avoids trajectories of whole periods


class Metric(eqx.Module):
    """Omega = M^(-1/2) = I + V^T diag(frequency - 1) V: `frequency` along the orthonormal rows of V, 1 across them.

    A diagonal mass is `basis = eye(d)`. Leading axes are shared with the positions' (one metric per population).
    """

    basis: Float[Array, "... r d"]
    frequency: Float[Array, "... r"]  # square roots of the inverse mass's eigenvalues, in (0, 1]

    def apply(
        self, along: Float[Array, "... p r"], across: Float[Array, "... p 1"], x: Float[Array, "... p d"]
    ) -> Array:
        """The function of Omega with eigenvalues `along` the basis and `across` it, applied to each row of x."""
        # Full precision: the reduced precision of tensor cores would break reversibility.
        inner = jnp.einsum("...pd,...rd->...pr", x, self.basis, precision="highest")
        return across * x + jnp.einsum("...pr,...rd->...pd", (along - across) * inner, self.basis, precision="highest")


def gradient_metric(force: Float[Array, "n d"], log_w: Float[Array, "n"], rank: int) -> Metric:
    """M = I + Cov(grad f) over weighted draws, restricted to its `rank` stiffest directions (stiffest first).

    For a path from the prior, a Gaussian likelihood of precision K and draws of the target, it is
    I + beta^2 K (I + beta K)^-1 K. In stiff directions this is close to the target's precision I + beta K. In
    directions that the likelihood does not constrain, it equals the prior's precision. It needs only as many draws as
    there are stiff directions, in any dimension.
    """
    weight = jnp.exp(log_w - jax.scipy.special.logsumexp(log_w))
    weight = jnp.where(jnp.isfinite(weight), weight, 0.0)
    # Clip: an overflow would make the whole population NaN. A slope of 10^12 already fixes its direction.
    g = jnp.clip(force, -1e12, 1e12)
    g = jnp.sqrt(weight)[:, None] * (g - weight @ g)
    g = jnp.pad(g, ((0, max(0, rank - len(g))), (0, 0)))
    if g.shape[1] > g.shape[0]:  # fewer draws than dimensions: work in the space that they span
        span, _ = jnp.linalg.qr(g.T)
        g = jnp.matmul(g, span, precision="highest")
    # An eigendecomposition is 30 times faster here than a singular value decomposition. Squaring loses variances that
    # are 10^7 times below the largest. This can cost speed, but not correctness: the basis stays orthonormal.
    variance, vectors = jnp.linalg.eigh(jnp.matmul(g.T, g, precision="highest"))
    variance, vectors = jnp.maximum(variance, 0.0)[::-1][:rank], vectors[:, ::-1][:, :rank]
    basis = vectors if g.shape[1] == force.shape[1] else jnp.matmul(span, vectors, precision="highest")
    return Metric(basis.T, 1.0 / jnp.sqrt(1.0 + variance))


class Target(eqx.Module):
    """r(q)^(1 - beta) (N(q; 0, I) exp(l(args, q)))^beta, with a metric (None: the identity)."""

    log_likelihood: LogLikelihood = eqx.field(static=True)
    args: Any
    beta: Float[Array, "..."]  # broadcasts against the positions' leading axes
    metric: Metric | None = None
    reference: Reference | None = None  # r; None: the prior

    def value(self, position: Float[Array, "... d"]) -> Float[Array, "..."]:
        """The log-likelihood at `position`, without its gradient; -inf if it is not finite."""
        value = self.log_likelihood(self.args, position.reshape(-1, position.shape[-1]))
        return jnp.where(jnp.isfinite(value), value, -jnp.inf).reshape(position.shape[:-1])

    def evaluate(self, position: Float[Array, "... d"]) -> "HMCState":
        """The target's terms at `position`. A log-likelihood that is not finite becomes -inf, with gradient 0."""
        flat = position.reshape(-1, position.shape[-1])
        value, pullback = jax.vjp(lambda q: self.log_likelihood(self.args, q), flat)
        (gradient,) = pullback(jnp.ones_like(value))
        alive = jnp.isfinite(value)
        value = jnp.where(alive, value, -jnp.inf)
        gradient = jnp.where(alive[:, None] & jnp.isfinite(gradient), gradient, 0.0)
        over, slope = jnp.zeros_like(value), jnp.zeros_like(gradient)
        if self.reference is not None:
            over, pullback = jax.vjp(self.reference.over_prior, flat)
            (slope,) = pullback(jnp.ones_like(value))
        each = (value, gradient, over, slope)
        return HMCState(position, *(a.reshape(*position.shape[:-1], *a.shape[1:]) for a in each))


class HMCState(eqx.Module):
    """Positions, and the target's terms there, which do not depend on beta."""

    position: Float[Array, "... d"]
    log_likelihood: Float[Array, "..."]  # -inf where the likelihood is not finite
    gradient: Float[Array, "... d"]  # of the log-likelihood
    over_prior: Float[Array, "..."]  # the reference's g
    over_gradient: Float[Array, "... d"]

    @property
    def log_ratio(self) -> Float[Array, "..."]:
        """log of (prior x likelihood) / reference. A step of beta adds step times this to the log weights."""
        return self.log_likelihood - self.over_prior

    def force(self, beta: Float[Array, "..."]) -> Float[Array, "... d"]:
        """grad f at `beta`, which broadcasts against the leading axes."""
        beta = jnp.asarray(beta)[..., None]
        return (1.0 - beta) * self.over_gradient + beta * self.gradient


class HMCInfo(eqx.Module):
    """Diagnostics of one HMC iteration, per chain."""

    acceptance: Float[Array, "..."]  # Metropolis acceptance probability
    accepted: Bool[Array, "..."]
    divergent: Bool[Array, "..."]
    energy_error: Float[Array, "..."]  # H(end) - H(start), nats


def leapfrog(
    state: HMCState, momentum: Float[Array, "... d"], target: Target, step_size: Float[Array, "..."], steps: int
) -> tuple[HMCState, Float[Array, "... d"]]:
    """`steps` steps of the split integrator: half kick by f, exact rotation under the prior, half kick.

    `step_size` broadcasts against the leading axes. `momentum` is the whitened v. Each step needs one gradient. The map
    preserves volume and is reversible: flip the momentum to go back.
    """
    epsilon = jnp.broadcast_to(step_size, state.position.shape[:-1])[..., None]
    push, beta = 0.5 * epsilon, jnp.broadcast_to(target.beta, epsilon.shape[:-1])
    metric = target.metric

    if metric is None:
        cosine, sine = jnp.cos(epsilon), jnp.sin(epsilon)

        def turn(q, v):
            return cosine * q + sine * v, cosine * v - sine * q

        def kick(v, gradient):
            return v + push * gradient
    else:
        omega = metric.frequency[..., None, :]
        cosines = jnp.cos(omega * epsilon), jnp.cos(epsilon)
        sines = jnp.sin(omega * epsilon), jnp.sin(epsilon)

        def turn(q, v):
            return (
                metric.apply(*cosines, q) + metric.apply(*sines, v),
                metric.apply(*cosines, v) - metric.apply(*sines, q),
            )

        def kick(v, gradient):
            return v + metric.apply(omega * push, push, gradient)

    def step(carry, _):
        state, v = carry
        q, v = turn(state.position, kick(v, state.force(beta)))
        state = target.evaluate(q)
        return (state, kick(v, state.force(beta))), None

    (state, momentum), _ = jax.lax.scan(step, (state, momentum), length=steps)
    return state, momentum


def energy_error(
    start: HMCState, v0: Array, end: HMCState, v1: Array, beta: Float[Array, "..."]
) -> Float[Array, "..."]:
    """H(end) - H(start), as a sum of differences. H can be 10^4, while a difference of 10^-2 matters."""
    quadratic = (end.position - start.position) * (end.position + start.position) + (v1 - v0) * (v1 + v0)
    # At beta = 0 the target does not depend on the likelihood, so a log-likelihood of -inf is allowed.
    likelihood = jnp.where(beta > 0, beta * (end.log_likelihood - start.log_likelihood), 0.0)
    return 0.5 * jnp.sum(quadratic, axis=-1) - likelihood - (1.0 - beta) * (end.over_prior - start.over_prior)


def hmc_step(
    key: PRNGKeyArray, state: HMCState, target: Target, step_size: Float[Array, "..."], steps: int
) -> tuple[HMCState, HMCInfo]:
    """One HMC iteration of every chain: fresh momentum, jittered step size, exact Metropolis test.

    A trajectory whose energy error is not finite or exceeds MAX_ENERGY_ERROR is divergent and rejected.
    """
    momentum_key, uniform_key = jax.random.split(key)
    momentum = jax.random.normal(momentum_key, state.position.shape)
    chains = state.log_likelihood.shape
    uniform = jax.random.uniform(uniform_key, (2, *chains))
    jitter = JITTER[0] + (JITTER[1] - JITTER[0]) * uniform[0]
    end, end_momentum = leapfrog(state, momentum, target, step_size * jitter, steps)

    error = energy_error(state, momentum, end, end_momentum, target.beta)
    divergent = ~jnp.isfinite(error) | (error > MAX_ENERGY_ERROR)
    acceptance = jnp.where(divergent, 0.0, jnp.exp(-jnp.maximum(error, 0.0)))
    accepted = uniform[1] < acceptance
    state = jax.tree.map(
        lambda a, b: jnp.where(accepted.reshape(chains + (1,) * (a.ndim - len(chains))), a, b), end, state
    )
    return state, HMCInfo(acceptance, accepted, divergent, error)


def split_r_hat(draws: Float[np.ndarray, "chains n"]) -> float:
    """Split R-hat (Gelman et al., BDA3 eq. 11.4) of a scalar; NaN if undefined (fewer than 4 draws, or all equal)."""
    half = draws.shape[1] // 2
    if half < 2 or not np.all(np.isfinite(draws)):
        return float("nan")
    halves = np.concatenate([draws[:, :half], draws[:, -half:]]).astype(np.float64)
    within = halves.var(axis=1, ddof=1).mean()
    between = halves.mean(axis=1).var(ddof=1)
    return float(np.sqrt((half - 1) / half + between / within)) if within > 0 else float("nan")


@dataclass(frozen=True)
class StageInfo:
    """Progress of a sampler after one stage. Tuples have one entry per population (for HMC, one for all chains)."""

    stage: int  # 0 is the start
    beta: tuple[float, ...]  # inverse temperature reached; 1 is the posterior
    ess: tuple[float, ...]  # effective sample size of the last importance weights (NaN where there were none)
    acceptance: tuple[float, ...]
    step_size: tuple[float, ...]
    log_evidence: tuple[float, ...]  # of the tempered target at `beta` (NaN for samplers that have none)
    divergences: int  # so far
    seconds: float  # since the start
    samples: Callable[[], Posterior]  # the current draws, of the target at `beta`; built when called
