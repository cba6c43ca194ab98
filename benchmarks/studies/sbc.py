"""Simulation-based calibration: whether the sampler returns the posterior of its own model.

A position is drawn from the prior N(0, I), pixels from the density that the likelihood evaluates (`draw_pixels`), and
the sampler answers. Over many such draws the rank of the truth among the posterior's weighted samples is uniform for
any statistic (Talts et al. 2018). Volumes have atoms, so ranks are randomised. No sensor and no foreign shape enters:
an error here is the sampler's, and an error only elsewhere (`farside bench hidden`) is the model's. Statistics, each
of the shape on 24^3 voxels:

- volume: of the whole shape. hidden: of its half away from the camera. voxel: whether one random far voxel is solid.
- yaw: where the pose is unknown.
- delta: mean square of the weights' perturbation where it is sampled; a picture says almost nothing about it.
- log_likelihood: of the pixels.

`cylinder` is an analytic field. The tiny field is a ProbNeRF with the weights that training begins with: shapes like
clouds, and few enough weights for 200 draws with delta; `eight times the particles` are the first of the same draws,
and tell which errors are of too few. The quick sampler is the shipped one, but all of its particles start from the
prior, because no picture is drawn for the encoder, and it makes one run.

`begun at the network`: tempering begins at the shipped prior's network, which is shown another picture of the same
truth from where the pixels were seen, as clean as a camera's (`CLEAN`). Where the network misses the truth, tempering
begins at the mixture's share of the prior. *Moved longer*: with six times the stages at beta = 1. *As it ships*: with
as few particles and moves as an answer has.

outside: how far the ranks' distribution function leaves the band that holds 95% of uniform samples as a whole
(`metrics.uniform_band`); 0 if it stays inside. coverage90: share of truths in the central 90%.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from matplotlib.figure import Figure

from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, key
from benchmarks.harness.rows import Row
from benchmarks.harness.study import ResumedOptions, Summary, results_of, resumed, selected
from benchmarks.harness.tables import Table, gated
from benchmarks.measures.metrics import coverage, ks_distance, randomised_rank, uniform_band
from probnerf.fields.base import Model
from probnerf.fields.cylinder import CylinderModel
from probnerf.geometry import look_at, pinhole_rays
from probnerf.inference import likelihood_of, likelihood_settings, suited
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.position import pose_of
from probnerf.likelihood.settings import Likelihood
from probnerf.network_start import defensive, picture_density
from probnerf.objects.cylinder_scenes import draw_pixels, grid_of_rays
from probnerf.pixel_status import OBJECT
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.rendering.occupancy import solid, voxel_centres
from probnerf.sampling.defensive_mixture import DefensiveMixture
from probnerf.sampling.populations import thin
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import InferConfig, NetworkConfig, TemperedSMCConfig
from probnerf.shapes import opacity_grids
from probnerf.types import POSE_SIZE, Observation, Posterior, Rays

GRID = 24
POSE_SIGMA = (0.08, 0.08, 0.06, 0.02, 0.03)  # of perception's usual widths, cube units
STATISTICS = ("volume", "hidden", "voxel", "yaw", "delta", "log_likelihood")
# of the network's picture: a camera's noise, with which it has learnt, instead of the likelihood's
CLEAN = (0.02, 0.0, 0.0, 0.01)  # colour_sigma, outlier, mask_error, wall_sigma
TABLE = 0.6  # colour of the table in the network's picture
LEAST = 50  # draws, without which a band says nothing
DRAWS = 64  # posterior samples that ranks are taken among


@dataclass(frozen=True)
class Condition:
    """A model, what of it is unknown, and a sampler."""

    name: str
    model: Callable[[], Model]
    sampler: TemperedSMCConfig
    pose: bool = True
    delta: bool = False
    columns: int = 6  # pixels: columns x rows
    rows: int = 5
    lattice: int = 12
    network: bool = False  # begin at the prior's posterior network, which is shown a picture of the same truth


@cache
def _shipped() -> Prior:
    return load_prior(None)


def _prior() -> Model:
    return _shipped().model


@cache
def _tiny() -> Model:
    return ProbNeRF(PRESETS["tiny"], jax.random.key(0))


def _on_prior(name: str, sampler: TemperedSMCConfig, pose: bool = True, network: bool = False) -> Condition:
    return Condition(name, _prior, sampler, pose, columns=8, rows=8, lattice=32, network=network)


THOROUGH = TemperedSMCConfig(populations=2, particles=96, start_particles=768, moves=4, final_stages=2, keep=2)
LARGE = TemperedSMCConfig(populations=4, particles=256, start_particles=1024)
QUICK = replace(InferConfig().smc_from_prior, evidence_power=1.0)  # what ships, but for its starts, runs and weights
NETWORK = TemperedSMCConfig(populations=4, particles=64, start_particles=512, moves=2, final_stages=4, keep=4)
CONDITIONS = (
    Condition("cylinder", CylinderModel, TemperedSMCConfig()),
    Condition("cylinder, pose known", CylinderModel, TemperedSMCConfig(), pose=False),
    Condition("tiny field, delta", _tiny, TemperedSMCConfig(), delta=True),
    Condition("tiny field, delta, eight times the particles", _tiny, LARGE, delta=True),
    Condition("tiny field, delta, pose known", _tiny, TemperedSMCConfig(), pose=False, delta=True),
    _on_prior("shipped prior, pose known", THOROUGH, pose=False),
    _on_prior("shipped prior", THOROUGH),
    Condition("cylinder, quick sampler", CylinderModel, QUICK),
    _on_prior("shipped prior, quick sampler", QUICK),
    _on_prior("begun at the network, pose known", NETWORK, pose=False, network=True),
    _on_prior("begun at the network", NETWORK, network=True),
    _on_prior("begun at the network, moved longer", replace(NETWORK, final_stages=24, keep=12), network=True),
    _on_prior("begun at the network, as it ships", InferConfig().smc_from_network, network=True),
)


def _settings(condition: Condition) -> InferConfig:
    """Inference's, as a density of pixels: no end to the ranges' reach, and each pixel counted once."""
    config = replace(InferConfig(), reach=1e6, power=1.0, sample_delta=condition.delta, lattice=condition.lattice)
    return suited(config, condition.model())


def statistics(
    model: Model, likelihood: Likelihood, positions: Float[Array, "s d"], pose_sigma: Float[Array, "5"], voxel: int
) -> dict[str, Float[np.ndarray, "s"]]:
    """Of each position's shape; `voxel` counts those of the far half, which the camera at +x looks at last."""
    opacity = opacity_grids(model, likelihood, positions, pose_sigma, jnp.ones((GRID,) * 3, bool))
    shapes = solid(np.asarray(opacity)).reshape(len(positions), -1)
    far = np.flatnonzero(voxel_centres(GRID)[..., 0].ravel() < 0.0)
    found = {
        "volume": shapes.sum(axis=1),
        "hidden": shapes[:, far].sum(axis=1),
        "voxel": shapes[:, far[voxel % len(far)]],
    }
    rest = positions[:, model.latent :]
    if likelihood.sample_pose:
        pose, rest = rest[:, :POSE_SIZE], rest[:, POSE_SIZE:]
        found["yaw"] = np.asarray(pose_of(pose, pose_sigma).yaw)
    if likelihood.sample_delta:
        found["delta"] = np.mean(np.square(np.asarray(rest)), axis=1)
    return {name: np.asarray(value, np.float64) for name, value in found.items()}


def drawn_from(
    condition: Condition, model: Model, seed: int
) -> tuple[Float[Array, "d"], Likelihood, Observation, DefensiveMixture | None]:
    """A truth from the prior, the likelihood that draws its pixels, these, and where tempering begins."""
    key = jax.random.key(seed)
    rays = grid_of_rays(condition.columns, condition.rows, elevation=30.0)
    pose_sigma = jnp.asarray(POSE_SIGMA if condition.pose else np.zeros(5), jnp.float32)
    every, yes = jnp.ones(condition.columns * condition.rows, bool), jnp.asarray(True)
    drawn = likelihood_settings(_settings(condition), condition.pose)
    truth = jax.random.normal(jax.random.fold_in(key, 0), (drawn.dim(model),))
    observation = draw_pixels(jax.random.fold_in(key, 1), model, drawn, truth, rays, every, yes, pose_sigma=pose_sigma)
    reference = _reference(condition, jax.random.fold_in(key, 3), model, drawn, truth, observation)
    return truth, drawn, observation, reference


def ranks_of(condition: Condition, model: Model, seed: int) -> tuple[dict[str, float], Posterior]:
    """The truth's randomised ranks in one draw from the model, by statistic, and the posterior."""
    rng = np.random.default_rng([seed, 41])
    truth, drawn, observation, reference = drawn_from(condition, model, seed)
    likelihood = likelihood_of(_settings(condition), observation, sample_pose=condition.pose)
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    key = jax.random.fold_in(jax.random.key(seed), 2)
    posterior = tempered_smc(key, log_likelihood, args, drawn.dim(model), condition.sampler, reference=reference)
    chosen, weights, _ = thin(posterior, DRAWS)
    positions = jnp.concatenate([truth[None], posterior.positions[jnp.asarray(chosen)]])
    voxel = int(rng.integers(2**31))
    found = statistics(model, likelihood, positions, observation.pose_sigma, voxel)
    found["log_likelihood"] = np.asarray(_value(args, positions), np.float64)
    ranks = {name: randomised_rank(v[1:], weights, v[0], rng) for name, v in found.items()}
    return ranks, posterior


def _reference(
    condition: Condition,
    key: PRNGKeyArray,
    model: Model,
    likelihood: Likelihood,
    truth: Float[Array, "d"],
    observation: Observation,
) -> DefensiveMixture | None:
    """The network's density, of a picture of the truth from where the pixels were seen; None: begin at the prior.

    Whatever the network says, the target is the posterior given the pixels, so the law of the ranks holds.
    """
    if not condition.network:
        return None
    network = _shipped().network
    assert network is not None, "the shipped prior has a posterior network"
    size, camera = network.sizes.image_size, np.asarray(observation.rays.origin[0], np.float64)
    tan_half = ENCODER_RADIUS / float(np.linalg.norm(camera))
    T_object_camera = look_at(camera, np.zeros(3))
    rays = Rays(*(jnp.asarray(a) for a in pinhole_rays(T_object_camera, 0.5 * size / tan_half, size)))
    every, yes = jnp.ones(size * size, bool), jnp.asarray(True)
    clean = replace(likelihood, colour_sigma=CLEAN[0], outlier=CLEAN[1], mask_error=CLEAN[2], wall_sigma=CLEAN[3])
    seen = draw_pixels(key, model, clean, truth, rays, every, yes, pose_sigma=observation.pose_sigma)
    is_object = (seen.status == OBJECT).reshape(size, size)
    picture = EncoderPicture(
        rgb=jnp.where(is_object[..., None], jnp.clip(seen.rgb, 0.0, 1.0).reshape(size, size, 3), TABLE),
        distance=jnp.where(is_object, seen.range.reshape(size, size), 0.0),
        unknown=jnp.zeros((size, size)),
        T_view_camera=jnp.asarray(T_object_camera, jnp.float32),
        tan_half_fov=jnp.asarray(tan_half),
    )
    return defensive(picture_density(network, picture, observation, condition.pose), NetworkConfig())


@jax.jit
def _value(args, positions):
    return log_likelihood(args, positions)


def identity(condition: Condition, prior: str) -> Line:
    """What makes a draw of this condition the same one, but for its number."""
    description = {"sampler": asdict(condition.sampler), "infer": asdict(_settings(condition)), "pose": condition.pose}
    description |= {"network": CLEAN} if condition.network else {}
    description |= {"pixels": [condition.columns, condition.rows], "grid": GRID, "draws": DRAWS, "widths": POSE_SIGMA}
    settings = {"digest": digest(description)}
    same = {"method": "tempered_smc", "condition": condition.name, "settings": settings, "seed": 0}
    return {"prior": prior if condition.model is _prior else "", **same}


@dataclass(frozen=True)
class Options(ResumedOptions):
    """Simulation-based calibration of tempered SMC: ranks of the truth in draws from the model itself."""

    n: int = 200
    """Draws of each condition."""
    conditions: str = ""
    """Only these, by name, separated by semicolons."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=min(options.n, 20))
    names = selected(options.conditions, [c.name for c in CONDITIONS], "condition")
    chosen = [c for c in CONDITIONS if c.name in names]
    results = results_of("sbc", options)
    prior = _shipped().hash if any(c.model is _prior for c in chosen) else ""
    wanted = {key({**identity(c, prior), "object": number}) for c in chosen for number in range(options.n)}
    return resumed(
        results,
        options,
        lambda: _measure(options, chosen, prior, results),
        lambda: summary([line for line in results.lines if key(line) in wanted], options),
    )


def _measure(options: Options, chosen: list[Condition], prior: str, results: Results) -> None:
    for condition in chosen:
        model = None
        for number in range(options.n):
            line: Line = {**identity(condition, prior), "object": number}
            if line in results:
                continue
            model = model or condition.model()
            ranks, posterior = ranks_of(condition, model, number)
            rounded = {name: round(rank, 4) for name, rank in ranks.items()}
            results.add({**line, "ranks": rounded, "result": posterior.result})
            if (number + 1) % 20 == 0:
                say(f"{condition.name}: {number + 1} of {options.n} draws ({posterior.result})")


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of every condition that has ranks; None where there are none."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for condition in CONDITIONS:
        own = [line for line in lines if line["condition"] == condition.name]
        own = sorted((x for x in own if x["settings"] == own[-1]["settings"]), key=lambda x: x["object"])
        if own:
            ranks = [line["ranks"] for line in own]
            found[condition.name] = {name: np.array([r[name] for r in ranks]) for name in ranks[0]}
    if not found:
        return None
    rows, cells = [], []
    for name, by in found.items():
        for statistic, u in by.items():
            values = {"outside": outside(u), "ks": ks_distance(u), "coverage90": coverage(u)}
            rows += [Row("sbc", name, statistic, metric, value, "", len(u)) for metric, value in values.items()]
            left = f"{values['outside']:.3f}"
            left = gated(left, values["outside"], most=0.0) if len(u) >= LEAST else "too few draws"
            cells.append([name, str(len(u)), statistic, f"{values['coverage90']:.3f}", f"{values['ks']:.3f}", left])
    header = ("condition", "draws", "statistic", "coverage90 (right: 0.9)", "ks", "outside the band, gate 0")
    return Summary(rows, [Table("Ranks of the truth", header, cells)], lambda: _draw(found))


def outside(ranks: Float[np.ndarray, "n"], level: float = 0.95) -> float:
    """The farthest that the ranks' distribution function leaves the simultaneous band that holds `level` of samples."""
    at, low, high = uniform_band(len(ranks), level)
    share = np.mean(np.asarray(ranks)[:, None] <= at, axis=0)
    return float(max(0.0, np.max(low - share), np.max(share - high)))


def _draw(found: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Each condition's rank distribution functions, less the uniform one, with the band; those of enough draws."""
    found = {name: by for name, by in found.items() if len(next(iter(by.values()))) >= LEAST} or found
    figure = Figure(figsize=(4.2 * min(3, len(found)), 3.4 * -(-len(found) // 3)), layout="constrained")
    axes = figure.subplots(-(-len(found) // 3), min(3, len(found)), squeeze=False, sharey=True)
    for ax in axes.ravel()[len(found) :]:
        ax.set_axis_off()
    for ax, (name, by) in zip(axes.ravel(), found.items(), strict=False):
        at, low, high = uniform_band(len(next(iter(by.values()))))
        ax.fill_between(at, low - at, high - at, color="0.85", label="95% of uniform samples")
        for statistic, u in by.items():
            share = np.mean(u[:, None] <= at, axis=0)
            ax.plot(at, share - at, color=f"C{STATISTICS.index(statistic)}", label=statistic, linewidth=1.2)
        ax.axhline(0.0, color="k", linewidth=0.6)
        ax.set(title=name, xlabel="rank of the truth")
        ax.title.set_fontsize(9)
    axes[0, 0].set_ylabel("share of ranks below, less uniform")
    drawn = dict(pair for ax in axes.flat for pair in zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    axes[0, 0].legend(drawn.values(), drawn.keys(), fontsize=7)
    return figure
