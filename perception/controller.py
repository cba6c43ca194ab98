"""How much model a scene needs: from a frame's segment to published hypotheses. One fixed amount so far."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from perception.hypotheses import Hypotheses
from perception.observe import ObjectFrame, ObserveConfig, observe
from perception.seen import seen_voxels
from perception.segment import Segment
from perception.source import Frame
from probnerf.families.render import look_at, pinhole_rays
from probnerf.hmc import StageInfo
from probnerf.infer import (
    InferConfig,
    crossings_of,
    explained,
    infer,
    likelihood_of,
    opacity_grids,
    poses,
    scaled_about,
    thin,
    without_sizes,
)
from probnerf.model import Likelihood
from probnerf.proposal import Picture
from probnerf.store import Prior
from probnerf.types import BASE_Z, OBJECT, UNKNOWN, Observation, Posterior
from probnerf.views import ENCODER_RADIUS


@dataclass(frozen=True)
class ControllerConfig:
    """What is inferred, and how finely it is published."""

    infer: InferConfig = field(default_factory=InferConfig)
    observe: ObserveConfig = field(default_factory=ObserveConfig)
    hypotheses: int = 48  # shapes published
    first_hypotheses: int = 16  # ... while better ones are under way
    grid: int = 64  # voxels per axis, G
    out_of_model_below: float = 0.8  # share of telling pixels explained on average; validation vessels: 0.86 to 0.98

    def __post_init__(self) -> None:
        if min(self.hypotheses, self.first_hypotheses, self.grid) < 1 or self.grid > 512:
            raise ValueError(
                f"hypotheses {self.hypotheses} and first_hypotheses {self.first_hypotheses} must be 1 or more, and grid"
                f" {self.grid} from 1 to 512"
            )


@dataclass(frozen=True, eq=False)
class Estimate:
    """Everything known of one object: what is published, and what it was made from."""

    hypotheses: Hypotheses
    posterior: Posterior
    likelihood: Likelihood
    observation: Observation
    object_frame: ObjectFrame
    seconds: float


def estimate(
    frame: Frame,
    segment: Segment,
    prior: Prior,
    config: ControllerConfig | None = None,
    *,
    seed: int = 0,
    budget_s: float | None = None,
    stages: int | None = None,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    on_answer: Callable[[Hypotheses], None] | None = None,
) -> Estimate:
    """Hypotheses about one object of a frame; first ones, of fewer shapes, go to `on_answer` while it works.

    With `stages` and no budget the answer is a function of the inputs alone.

    Raises ValueError where the segment cannot be observed (too small, outside the prior's range of sizes).
    """
    config = config or ControllerConfig()
    begun = time.monotonic()
    observation, cube = observe(frame, segment, config.observe, seed)
    view = View(frame, segment, observation, cube, seen_voxels(frame, segment, cube, config.grid))
    return infer_view(
        view,
        prior,
        config,
        seed=seed,
        deadline=None if budget_s is None else begun + budget_s,
        stages=stages,
        on_stage=on_stage,
        on_answer=on_answer,
    )


@dataclass(frozen=True, eq=False)
class View:
    """What is conditioned on, and the frame that the answer is given in: the newest one."""

    frame: Frame
    segment: Segment
    observation: Observation  # of this frame, or of several joined
    object_frame: ObjectFrame  # in this frame's camera
    seen: Bool[np.ndarray, "g g g"]  # by any frame


def infer_view(
    view: View,
    prior: Prior,
    config: ControllerConfig,
    *,
    seed: int = 0,
    before: Posterior | None = None,
    deadline: float | None = None,
    stages: int | None = None,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    on_answer: Callable[[Hypotheses], None] | None = None,
) -> Estimate:
    """Sample the posterior of a view and publish it; `before` is the posterior of an earlier view of the same cube."""
    begun = time.monotonic()
    likelihood = likelihood_of(config.infer, view.observation)
    first = replace(config, hypotheses=config.first_hypotheses)
    answered, cost = begun, 0.0

    def told(info: StageInfo) -> bool | None:
        nonlocal answered, cost
        if on_stage is not None and on_stage(info):
            return True
        now = time.monotonic()
        # the first answer at once; a later one when the time it takes is a fifth of what went by
        if on_answer is not None and now - answered >= 4.0 * cost:
            on_answer(published(view, info.samples(), likelihood, prior, first, seed))
            answered = time.monotonic()
            cost = answered - now
        return None

    # The encoder was trained on objects with ranges. Without, its starts are no better than the prior's: on eight
    # validation objects a third of their effective number at a temperature of 10, and no higher likelihood.
    size = prior.model.preset.image_size
    picture = None if view.frame.depth is None else crop(view.frame, view.segment, view.object_frame, size)
    posterior, likelihood = infer(
        jax.random.key(seed),
        prior.model,
        view.observation,
        config.infer,
        picture=picture,
        before=before,
        on_stage=told,
        deadline=deadline,
        stages=stages,
    )
    hypotheses = published(view, posterior, likelihood, prior, config, seed)
    if on_answer is not None:
        on_answer(hypotheses)
    seconds = time.monotonic() - begun
    return Estimate(hypotheses, posterior, likelihood, view.observation, view.object_frame, seconds)


def published(
    view: View, posterior: Posterior, likelihood: Likelihood, prior: Prior, config: ControllerConfig, seed: int
) -> Hypotheses:
    """A posterior as planners read it."""
    chosen, weights, population = thin(posterior, config.hypotheses)
    sizeless = without_sizes(likelihood)
    positions, pose_sigma = posterior.positions[jnp.asarray(chosen)], view.observation.pose_sigma
    fit = float(weights @ np.asarray(explained(prior.model, sizeless, view.observation, positions), np.float64))
    cube = view.object_frame
    if cube.sight_sigma > 0.0:  # what no pixel tells is not sampled: each sample draws it from its prior
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = cube.sight_sigma * jax.random.normal(key, posterior.log_weights.shape)
        camera = jnp.asarray(cube.to_cube(np.zeros(3)), jnp.float32)
        positions = scaled_about(prior.model, positions, pose_sigma, camera, drawn[jnp.asarray(chosen)])
    opacity = opacity_grids(prior.model, sizeless, positions, pose_sigma, grid=config.grid)
    pose = poses(prior.model, sizeless, positions, pose_sigma)
    d = posterior.diagnostics
    draft = Hypotheses(
        stamp_ns=view.frame.stamp_ns,
        frame_id=view.frame.frame_id,
        object_id=view.segment.id,
        label="",
        object_frame=view.object_frame,
        T_world_camera=view.frame.T_world_camera,
        opacity=np.asarray(opacity),
        pose=np.stack([np.asarray(a) for a in (pose.yaw, pose.x, pose.y, pose.log_scale, pose.z)], axis=-1),
        weights=weights,
        population=population,
        seen=view.seen,
        inside_view=_inside_picture(view.segment),
        out_of_model=fit < config.out_of_model_below,
        stage=int(d.stages),
        monte_carlo_error=0.0,
        prior_hash=prior.hash,
        seed=seed,
        diagnostics={
            "acceptance": float(d.acceptance),
            "divergences": float(d.divergences),
            "r_hat": float(d.r_hat),
            "ess": float(d.ess),
            "ancestors": float(d.ancestors),
            "beta": float(d.beta.min()),
            "log_evidence": float(posterior.log_evidence),
            "log_evidence_se": float(posterior.log_evidence_se),
            "point_gradients": float(d.point_gradients) * crossings_of(likelihood, view.observation),
            "explained": fit,
            "power": likelihood.power,
            "evidence_power": config.infer.smc.evidence_power,
        },
        result=posterior.result,
    )
    return _with_error(draft)


def _with_error(h: Hypotheses) -> Hypotheses:
    """Fill in the standard error of the mean occupancy of unseen voxels above the plane."""
    z = -1.0 + (np.arange(h.grid) + 0.5) * 2.0 / h.grid
    hidden = ~h.seen & (z > BASE_Z)
    # one shape at a time: to index them all at once would stop every other thread for a fifth of a second
    count = np.array([np.count_nonzero(shape & hidden) for shape in h.solid])
    return replace(h, monte_carlo_error=float(h.estimate(count / max(hidden.sum(), 1))[1]))


def _inside_picture(segment: Segment) -> bool:
    border = np.concatenate([segment.mask[0], segment.mask[-1], segment.mask[:, 0], segment.mask[:, -1]])
    return not bool(border.any())


def crop(frame: Frame, segment: Segment, cube: ObjectFrame, size: int) -> Picture:
    """The encoder's picture: the frame as seen by a camera at the same place that looks at the cube's centre.

    A rotation of the camera moves no parallax, so this is a look-up: each pixel takes the nearest one of the frame.
    """
    centre = cube.to_cube(np.zeros(3))
    tan_half = ENCODER_RADIUS / float(np.linalg.norm(centre))
    T_view_camera = look_at(centre, np.zeros(3))
    _, directions = pinhole_rays(T_view_camera, 0.5 * size / tan_half, size)
    rays = directions.astype(np.float64) @ cube.T_camera_object[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.round(frame.camera.project(rays)).astype(int)
    height, width = segment.mask.shape
    inside = (rays[:, 2] > 0) & np.all((pixels >= 0) & (pixels < [width, height]), axis=1)
    u, v = np.where(inside[:, None], pixels, 0).T
    status = np.where(inside, segment.status[v, u], UNKNOWN)
    assert frame.depth is not None
    z = frame.depth[v, u]
    range_cube = np.where(np.isfinite(z), z, 0.0) / np.maximum(rays[:, 2], 1e-6) / cube.half_extent
    is_object = status == OBJECT
    return Picture(
        rgb=jnp.asarray((frame.rgb[v, u] / 255.0).reshape(size, size, 3), jnp.float32),
        distance=jnp.asarray(
            np.where(is_object, np.where(np.isfinite(z), range_cube, -1.0), 0.0).reshape(size, size), jnp.float32
        ),
        unknown=jnp.asarray((status == UNKNOWN).reshape(size, size), jnp.float32),
        T_view_camera=jnp.asarray(T_view_camera, jnp.float32),
        tan_half_fov=jnp.asarray(tan_half, jnp.float32),
    )
