"""From a posterior's samples to Hypotheses."""

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.inference.hilbert_map import HilbertMap, hilbert_map
from perception.inference.settings import PublishConfig
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import Segment
from perception.observation.visibility import answered_voxels, surface_voxels
from perception.sources.frame import Frame
from probnerf.inference import without_sizes
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering.occupancy import WALL_OPACITY
from probnerf.sampling.populations import thin
from probnerf.shapes import explained, opacity_grids, poses, scaled_about
from probnerf.types import Observation, Posterior, joined, stacked

# chosen by the scans' scores (`farside bench strangers`)
HEDGE = 2.0  # 1 to 4 are as good within 0.01 nats
SMOOTH_ABOVE = 0.1  # share of pixels not explained


@dataclass(frozen=True, eq=False)
class ConditionedView:
    """The observation that inference is conditioned on, and the frame of the answer: the newest one."""

    frame: Frame
    segment: Segment
    observations: tuple[Observation, ...]  # of this frame, or of several joined; each of its own choice of pixels
    object_frame: ObjectFrame  # in this frame's camera
    seen: Bool[np.ndarray, "g g g"]  # by any frame
    pose_known: bool = False  # `object_frame` is the object's own cube (the handle at +x): only the shape is inferred

    @property
    def observation(self) -> Observation:
        """Of the first choice of pixels."""
        return self.observations[0]

    @cached_property
    def every_choice(self) -> Observation:
        """All choices of pixels, along a leading axis."""
        return stacked(self.observations) if len(self.observations) > 1 else self.observation

    @cached_property
    def every_pixel(self) -> Observation:
        """The pixels of all choices as one observation."""
        return joined(self.observations)

    @cached_property
    def smooth_map(self) -> HilbertMap:
        """What the frame's depth says without knowing shapes."""
        return hilbert_map(self.frame, self.segment)


def published(
    view: ConditionedView,
    posterior: Posterior,
    likelihood: Likelihood,
    prior: Prior,
    config: PublishConfig,
    seed: int,
    point_gradients: float = float("nan"),
    evidence_power: float = float("nan"),
    guess: Posterior | None = None,
    early: bool = False,
) -> Hypotheses:
    """The posterior as Hypotheses. With a network's `guess`, where pixels stay unexplained, draws of it are among them
    (`_hedged`), and shapes of a smooth map (`_beside_smooth`).

    Of an `early` answer only one choice of pixels is asked what it leaves unexplained, which is cheaper.
    `point_gradients` and `evidence_power` become diagnostics of it.
    """
    chosen = _thinned(posterior, config.hypotheses)
    sizeless, pose_sigma = without_sizes(likelihood), view.observation.pose_sigma
    pixels = view.observation if early else view.every_pixel
    each = explained(prior.model, sizeless, pixels, _padded(chosen[0], config.hypotheses))
    fit = float(chosen[1] @ np.asarray(each, np.float64)[: len(chosen[1])])
    smooth = 0
    if guess is not None and fit < 1.0:
        room = max(config.hypotheses - len(np.unique(chosen[2])), 0)  # every population keeps a shape of its own
        if view.frame.depth is not None and 1.0 - fit > SMOOTH_ABOVE:
            smooth = min(round(config.hypotheses * (1.0 - fit)), room // 2)
        learnt = config.hypotheses - smooth
        share = min(HEDGE * (1.0 - fit), 1.0 - 1.0 / learnt)
        draws = min(round(learnt * share), room - smooth)
        chosen = _hedged(_thinned(posterior, learnt - draws), guess.positions, draws, share)
    positions, weights, population = chosen
    cube = view.object_frame
    if cube.sight_sigma > 0.0:  # no pixel informs it, so it is not sampled: each sample draws it from its prior
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = cube.sight_sigma * jax.random.normal(key, weights.shape)
        camera = jnp.asarray(cube.to_cube(np.zeros(3)), jnp.float32)
        positions = scaled_about(prior.model, positions, pose_sigma, camera, drawn)
    scaled = view.frame.depth is not None and cube.sight_sigma > 0.0  # then measured places are not certain
    region = answered_voxels(view.frame, view.segment, cube, config.grid) | scaled
    padded, count = _padded(positions, config.hypotheses), len(weights)
    opacity = opacity_grids(prior.model, sizeless, padded, pose_sigma, jax.device_put(region), coarse=config.coarse)
    pose = poses(prior.model, sizeless, padded, pose_sigma)
    d = posterior.diagnostics
    draft = Hypotheses(
        stamp_ns=view.frame.stamp_ns,
        frame_id=view.frame.frame_id,
        object_id=view.segment.id,
        label="",
        object_frame=view.object_frame,
        T_world_camera=view.frame.T_world_camera,
        opacity=np.asarray(opacity)[:count],
        pose=np.stack([np.asarray(a)[:count] for a in (pose.yaw, pose.x, pose.y, pose.log_scale, pose.z)], axis=-1),
        weights=weights,
        population=population,
        seen=view.seen,
        inside_view=_inside_picture(view.segment),
        out_of_model=fit < _flagged_below(prior, config),
        stage=int(d.stages),
        monte_carlo_error=0.0,
        prior_hash=prior.identity,
        seed=seed,
        diagnostics=AnswerDiagnostics(
            acceptance=float(d.acceptance),
            divergences=float(d.divergences),
            r_hat=float(d.r_hat),
            ess=float(d.ess),
            ancestors=float(d.ancestors),
            beta=float(np.min(np.asarray(d.beta))),
            log_evidence=float(posterior.log_evidence),
            log_evidence_se=float(posterior.log_evidence_se),
            explained=fit,
            failed_populations=float(len(np.unique(posterior.population)) - len(np.unique(population))),
            power=likelihood.power,
            point_gradients=point_gradients,
            evidence_power=evidence_power,
        ),
        result=posterior.result,
    )
    mixed = _beside_smooth(draft, view.smooth_map, smooth, 1.0 - fit) if smooth else draft
    if cube.sight_sigma == 0.0:
        mixed = _with_surface(mixed, surface_voxels(view.frame, view.segment, cube, config.grid))
    return _with_error(mixed)


def _flagged_below(prior: Prior, config: PublishConfig) -> float:
    model = prior.model
    return min(config.out_of_model_below, model.preset.explains if isinstance(model, ProbNeRF) else 1.0)


_Chosen = tuple[Float[Array, "s d"], Float[np.ndarray, "s"], Int[np.ndarray, "s"]]  # positions, weights, populations


def _thinned(posterior: Posterior, count: int) -> _Chosen:
    # NumPy, because the number of samples varies, and nothing may compile for it
    chosen, weights, population = thin(posterior, count)
    return jax.device_put(np.asarray(posterior.positions)[chosen]), weights, population


def _padded(positions: Float[Array, "s d"], count: int) -> Float[Array, "p d"]:
    """At least `count` of them, the last one repeated: programs are compiled for that many, once."""
    missing = max(count - len(positions), 0)
    return jax.device_put(np.pad(np.asarray(positions), ((0, missing), (0, 0)), mode="edge")) if missing else positions


def _hedged(kept: _Chosen, draws: Float[Array, "n d"], count: int, share: float) -> _Chosen:
    """The kept shapes and `count` of the network's draws, which take a share of the weight.

    Their share is `HEDGE` times that of the pixels which no shape of the sampler explains. Where the prior cannot
    make what was seen, the sampler's shapes are those that fit least badly, each certain of its own error; the network,
    which was trained on views like this one, stays unsure. Every population gets as many draws, or one more: its own
    estimate is hedged as the whole is.
    """
    positions, weights, population = kept
    count = min(count, len(draws))
    if not count:
        return kept
    return (
        jax.device_put(np.concatenate([np.asarray(positions), np.asarray(draws)[:count]])),
        *_mixed(weights, population, count, share),
    )


def _beside_smooth(h: Hypotheses, smooth: HilbertMap, count: int, share: float) -> Hypotheses:
    """With so many shapes drawn from the map, which take a share of the weight: that of the pixels which no shape of
    the sampler explains.

    What the prior cannot make is guessed better by a map that knows no shapes; but where none of the learnt shapes
    reaches, these end: the map knows of nothing behind what was seen, and calls space free only before it.
    """
    made = smooth.shapes(h.object_frame, h.grid, count, h.seed) & h.solid[h.weights > 0.0].any(axis=0)
    weights, population = _mixed(h.weights, h.population, count, share)
    return replace(
        h,
        opacity=np.concatenate([h.opacity, np.where(made, np.uint8(255), np.uint8(0))]),
        pose=np.concatenate([h.pose, np.zeros((count, h.pose.shape[1]), h.pose.dtype)]),
        weights=weights,
        population=population,
    )


def _mixed(
    weights: Float[np.ndarray, "s"], population: Int[np.ndarray, "s"], count: int, share: float
) -> tuple[Float[np.ndarray, "s+count"], Int[np.ndarray, "s+count"]]:
    """Weights and populations with `count` more shapes, dealt to the populations in turn."""
    names = np.unique(population)
    dealt = names[np.arange(count) % len(names)]
    return np.concatenate([(1.0 - share) * weights, np.full(count, share / count)]), np.concatenate([population, dealt])


def _with_surface(h: Hypotheses, surface: Bool[np.ndarray, "G G G"]) -> Hypotheses:
    """With what the camera measured of the object in every shape: where a shape has no wall in a voxel of the measured
    surface, nor in one that shares a face with it, that voxel is made solid.

    So a part in plain sight that the prior cannot make is in every hypothesis; what is behind it is each shape's own.
    """
    at = np.argwhere(surface & h.seen)  # what is told of unseen space is not touched
    opacity = h.opacity.copy()
    for shape in opacity:
        walls = np.pad(shape >= 255.0 * WALL_OPACITY, 1)
        near = np.zeros(len(at), bool)
        for offset in np.argwhere(ndimage.generate_binary_structure(3, 1)):
            near |= walls[tuple((at + offset).T)]
        shape[tuple(at[~near].T)] = 255  # inside of a solid, too, where it is solid already
    return replace(h, opacity=opacity)


def _with_error(h: Hypotheses) -> Hypotheses:
    """Fill in the standard error of the mean occupancy of unseen voxels above the plane, and `expected_loss` there."""
    hidden = h.unseen
    # one shape at a time: to index them all at once would stop every other thread for a fifth of a second
    count = np.array([np.count_nonzero(shape & hidden) for shape in h.solid])
    return replace(
        h,
        monte_carlo_error=float(h.estimate(count / max(hidden.sum(), 1))[1]),
        diagnostics=replace(h.diagnostics, expected_loss=expected_loss(h, hidden)),
    )


def expected_loss(h: Hypotheses, region: Bool[np.ndarray, "G G G"]) -> float:
    """Expected loss of log score from having few populations, nats per voxel of a region.

    With independent estimates p_m of a voxel's probability, m = 1 .. M, of mean p and variance s^2, their mean's log
    score lies s^2 / M / (2 p (1 - p)) below that of p, to second order, if p is right. More populations could gain that
    much, and it falls with 1 / M. All populations with weight count equally. Each is represented by its published
    shapes; the fewer they are, the larger the loss. NaN with fewer than two populations.
    """
    names = np.unique(h.population[h.weights > 0.0])
    if len(names) < 2:
        return float("nan")
    total, squares = np.zeros(h.seen.shape, np.float32), np.zeros(h.seen.shape, np.float32)
    for name in names:  # one shape at a time, as above
        own, weight = np.zeros_like(total), h.weights[h.population == name].sum()
        for i in np.flatnonzero(h.population == name):
            own += np.float32(h.weights[i] / weight) * h.solid[i]
        total += own
        squares += np.square(own)
    p = total[region] / len(names)
    variance = np.maximum(squares[region] / len(names) - np.square(p), 0.0) / (len(names) - 1)
    open_to = (p > 0.0) & (p < 1.0)
    return float((variance[open_to] / (2.0 * p[open_to] * (1.0 - p[open_to]))).sum() / max(region.sum(), 1))


def _inside_picture(segment: Segment) -> bool:
    border = np.concatenate([segment.mask[0], segment.mask[-1], segment.mask[:, 0], segment.mask[:, -1]])
    return not bool(border.any())
