"""The fused kernel: operations per second beside the machine's matrix product and beside the same work in plain JAX.

One value and gradient of the pixel likelihood for every particle. All paths and the machine's matrix product are timed
in turn, round after round, and medians are given, so ratios also hold on a machine that does other work.

- operations: two for each multiply-add of the two networks at the crossings that a pixel depends on, times three
  (forwards, and backwards by inputs and by weights). Encodings, compositing and the likelihood's terms are not
  counted. All crossings are counted, as plain JAX evaluates them. The kernel skips colours and gradients of crossings
  without influence: in sharp shapes nine of ten. In "haze" every crossing counts, and the share is the machine's work.
- least_bytes: weights in and their gradient out, which the fused operation has to move. stored_bytes: the values of
  every layer at every crossing, which the plain path writes and reads again.
- share_of_peak: of the machine's single-precision matrix product, 4096 x 4096, in the same rounds.
- ratio: seconds of the plain path over the kernel's at equal work: from weights and pose, and from the latent code
  (with the hypernetwork and its gradient, which is JAX's in both).
- schedule: seconds that the paper's 100 x 100 leapfrog steps of eight chains take at that speed, by arithmetic.
- exponent: growth of the time with particles and with rays, fitted over a factor of 16 and of 8; 1 is linear.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from benchmarks.harness.machine import SIDE, median_seconds, squared
from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from perception.observation.rays import observe
from perception.observation.segmentation import segment
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.fields.mlp import MLPField, encoded_size
from probnerf.inference import likelihood_of, with_sizes
from probnerf.kernel import library
from probnerf.likelihood import kernel_call
from probnerf.likelihood.dispatch import log_likelihood, plain_log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.pixel_status import OBJECT
from probnerf.prior.checkpoint import load_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering.foam import FAR
from probnerf.settings import InferConfig
from probnerf.types import Observation, joined


class Given(eqx.Module):
    """A model whose latent code is the field's weights: no hypernetwork."""

    field: MLPField = eqx.field(static=True)

    @property
    def latent(self) -> int:
        """The number of weights."""
        return self.field.size

    def decode(self, z_tilde: Float[Array, "w"]) -> Float[Array, "w"]:
        """Itself."""
        return z_tilde


Prior = ProbNeRF | Given


class Haze(Given):
    """A field whose density lets light through: every crossing counts."""

    def decode(self, z_tilde: Float[Array, "w"]) -> Float[Array, "w"]:
        """Weights of natural size, with little density: an optical depth of 0.04 a face."""
        last = sum(math.prod(shape) for shape in self.field.shapes[:6]) - 1
        return (0.5 * z_tilde * self.field.weight_scale).at[last].set(-4.0)


CHAINS, SCHEDULE = 8, 100 * 100 + 1  # of the paper: chains, gradients of each


@dataclass(frozen=True)
class Options(TableOptions):
    """The kernel's speed beside plain JAX and the machine's matrix products."""

    repeats: int = 9
    """Rounds, of which medians are given (quick: 3)."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    quick, repeats = options.quick, options.repeats
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}; give 1 or more")
    if not library.available():
        raise ValueError("the kernel is not built: install a C++ compiler, then `make setup`")
    repeats = min(repeats, 3) if quick else repeats
    frame = next(iter(Log(SHIPPED_LOG)))
    view, _ = observe(frame, segment(frame)[0])
    shipped = load_prior().model
    cases: dict[str, tuple[ProbNeRF | Given, Observation, int]] = {
        "small, 384 particles x 64 rays": (shipped, view, 384)
    }
    if not quick:
        cases["small, 8 particles x 512 rays"] = (shipped, joined([view] * 8), 8)
        paper = ProbNeRF(PRESETS["paper"], jax.random.key(0))
        cases["paper, 8 particles x 512 rays"] = (paper, joined([view] * 8), 8)
        cases["small, haze, 384 particles x 64 rays"] = (Haze(shipped.field), view, 384)
        cases["paper, haze, 8 particles x 512 rays"] = (Haze(paper.field), joined([view] * 8), 8)
    rows = []
    for condition, (model, observation, particles) in cases.items():
        say(condition)
        rows += _measure(condition, model, observation, particles, repeats)
    grown = _growth(shipped, view, repeats)
    for method, points in grown.items():
        exponent = float(np.polyfit(np.log([n for n, _ in points]), np.log([t for _, t in points]), 1)[0])
        rows.append(Row("kernel", "kernel with hypernetwork", method, "exponent", exponent, "", repeats))
    return Summary(rows, picture=lambda: _draw(rows, grown))


def _growth(model: ProbNeRF, view: Observation, repeats: int) -> dict[str, list[tuple[int, float]]]:
    """(number, seconds) of a value and gradient by the number of particles, and of rays."""
    runs: dict[str, tuple[Callable, Array]] = {}
    sizes = {"particles, 64 rays": [(n, 1) for n in (48, 96, 192, 384, 768)]}
    sizes["rays, 96 particles"] = [(96, n) for n in (1, 2, 4, 8)]
    for condition, each in sizes.items():
        for particles, views in each:
            observation = joined([view] * views)
            likelihood = likelihood_of(InferConfig(), observation)
            args = (model, likelihood, observation, faces_of_view(observation, likelihood))
            q = 0.5 * jax.random.normal(jax.random.key(0), (particles, likelihood.dim(model)))
            runs[f"{condition}: {particles} {views}"] = (_whole(log_likelihood, args), q)
    seconds = median_seconds(runs, repeats)
    rays = view.status.size
    return {
        condition: [
            (
                particles if condition.startswith("particles") else views * rays,
                seconds[f"{condition}: {particles} {views}"],
            )
            for particles, views in each
        ]
        for condition, each in sizes.items()
    }


def _whole(function: Callable, args: tuple) -> Callable:
    return jax.jit(lambda q: jax.value_and_grad(lambda v: function(args, v).sum())(q))


def _measure(condition: str, model: Prior, observation: Observation, particles: int, repeats: int) -> list[Row]:
    likelihood = likelihood_of(InferConfig(), observation)
    t = faces_of_view(observation, likelihood)
    points, coloured = _crossings_needed(observation, np.asarray(t))
    field = model.field
    operations = 6.0 * particles * (points * _density_size(field) + coloured * _colour_size(field))
    layers = encoded_size(field.octaves, 3 + field.radial) + 2 * field.width
    stored = 4.0 * particles * (points + coloured) * layers
    packed = with_sizes(likelihood, observation)
    packed_t = faces_of_view(observation, packed)
    positions = 0.5 * jax.random.normal(jax.random.key(0), (particles, likelihood.dim(model)))
    weights = jax.jit(jax.vmap(model.decode))(positions[:, : model.latent])
    pose = jnp.zeros((particles, 6))
    placed = jnp.concatenate([weights, positions[:, model.latent :]], axis=1)
    given = Given(field)
    matrix = jnp.ones((SIDE, SIDE), jnp.float32)

    def kernel(threads: int | None = None, isa: str = "") -> Callable:
        return jax.jit(lambda w: kernel_call.call(field, likelihood, observation, t, w, pose, threads=threads, isa=isa))

    runs: dict[str, tuple[Callable, Array]] = {
        "matrix product": (squared, matrix),
        "kernel": (kernel(), weights),
        "kernel, one thread": (kernel(1), weights),
        "plain JAX": (_whole(plain_log_likelihood, (given, packed, observation, packed_t)), placed),
        "kernel with hypernetwork": (_whole(log_likelihood, (model, likelihood, observation, t)), positions),
        "plain JAX with hypernetwork": (
            _whole(plain_log_likelihood, (model, packed, observation, packed_t)),
            positions,
        ),
    }
    for isa in ("avx2", "plain"):
        try:
            jax.block_until_ready(kernel(isa=isa)(weights))
        except jax.errors.JaxRuntimeError:  # another kind of machine
            continue
        runs[f"kernel, {isa}"] = (kernel(isa=isa), weights)
    seconds = median_seconds(runs, repeats)
    peak = 2.0 * SIDE**3 / seconds["matrix product"]
    rows = [
        Row("kernel", "work", condition, "points", points * particles, "", particles),
        Row("kernel", "work", condition, "coloured_points", coloured * particles, "", particles),
        Row("kernel", "work", condition, "operations", operations * 1e-9, "GFLOP", particles),
        Row("kernel", "work", condition, "least_bytes", 8e-6 * particles * field.size, "MB", particles),
        Row("kernel", "work", condition, "stored_bytes", stored * 1e-6, "MB", particles),
        Row("kernel", "matrix product", condition, "speed", peak * 1e-9, "GFLOP/s", repeats),
    ]
    for method, taken in seconds.items():
        if method != "matrix product":
            rows.append(Row("kernel", method, condition, "time", 1e3 * taken, "ms", repeats))
            rows.append(Row("kernel", method, condition, "share_of_peak", operations / taken / peak, "", repeats))
    for path in ("", " with hypernetwork"):
        ratio = seconds[f"plain JAX{path}"] / seconds[f"kernel{path}"]
        rows.append(Row("kernel", f"kernel{path}", condition, "ratio", ratio, "", repeats))
    if particles == CHAINS:
        for method in ("kernel with hypernetwork", "plain JAX with hypernetwork"):
            rows.append(Row("kernel", method, condition, "schedule", SCHEDULE * seconds[method], "s", repeats))
    return rows


def _crossings_needed(observation: Observation, t: np.ndarray) -> tuple[int, int]:
    """Crossings at which density is needed, and colour."""
    each = (t < FAR).sum(axis=1)
    first = np.arange(len(each)) < observation.colour_count
    is_object = first & (np.asarray(observation.status) == OBJECT)
    telling = is_object | (np.asarray(observation.limit) > 0)
    return int(each[telling].sum()), int(each[is_object & np.asarray(observation.rgb_valid)].sum())


def _density_size(field: MLPField) -> int:
    """Multiply-adds of the density network at one point."""
    h = field.width
    return encoded_size(field.octaves, 3 + field.radial) * h + h * h + h


def _colour_size(field: MLPField) -> int:
    """... of the colour network; what the direction adds is the same for a whole ray."""
    h = field.width
    return (encoded_size(field.octaves, 3 + field.radial) + 1) * h + h * h + 3 * h


def _draw(rows: list[Row], grown: dict[str, list[tuple[int, float]]]) -> Figure:
    """Shares of the peak, by path and case; time by particles and by rays."""
    shares = [row for row in rows if row.metric == "share_of_peak"]
    conditions = list(dict.fromkeys(row.condition for row in shares))
    methods = list(dict.fromkeys(row.method for row in shares))
    figure = Figure(figsize=(13, 1.2 + 0.22 * len(shares)), layout="constrained", dpi=110)
    ax, growth = figure.subplots(1, 2, width_ratios=(2, 1))
    for condition, points in grown.items():
        growth.loglog(*zip(*points, strict=True), "o-", label=condition)
    n = np.array([32, 1024])
    growth.loglog(n, n * min(t / k for points in grown.values() for k, t in points), "k--", linewidth=1, label="linear")
    growth.set(xlabel="number", ylabel="seconds a value and gradient")
    growth.legend(fontsize=8)
    for i, condition in enumerate(conditions):
        there = [row for row in shares if row.condition == condition]
        at = [methods.index(row.method) + 0.8 * (i - (len(conditions) - 1) / 2) / len(conditions) for row in there]
        ax.barh(at, [100 * row.value for row in there], height=0.8 / len(conditions), label=condition)
    ax.set_yticks(range(len(methods)), methods)
    ax.invert_yaxis()
    ax.axvline(100.0, color="k", linewidth=0.7)
    ax.set(xlabel=f"operations of plain JAX over the machine's matrix product, % ({os.cpu_count()} cores)")
    ax.legend(fontsize=8)
    return figure
