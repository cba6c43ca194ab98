"""How much model a scene needs: from a frame's segment to published hypotheses. One fixed amount so far."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np

from perception.hypotheses import Hypotheses
from perception.observe import ObjectFrame, ObserveConfig, observe, seen_voxels
from perception.segment import Segment
from perception.source import Frame
from probnerf.families.render import look_at, pinhole_rays
from probnerf.hmc import StageInfo
from probnerf.infer import InferConfig, explained, infer, opacity_grids, poses, thin
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
    grid: int = 64  # voxels per axis, G
    out_of_model_below: float = 0.8  # share of telling pixels explained on average; validation vessels: 0.86 to 0.98


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
    on_stage: Callable[[StageInfo], None] | None = None,
) -> Estimate:
    """Hypotheses about one object of a frame. With `stages` and no budget the answer is a function of the inputs alone.

    Raises ValueError where the segment cannot be observed (too small, outside the prior's range of sizes).
    """
    config = config or ControllerConfig()
    begun = time.monotonic()
    observation, cube = observe(frame, segment, config.observe, seed)
    posterior, likelihood = infer(
        jax.random.key(seed),
        prior.model,
        observation,
        config.infer,
        picture=crop(frame, segment, cube, prior.model.preset.image_size),
        on_stage=on_stage,
        deadline=None if budget_s is None else begun + budget_s,
        stages=stages,
    )
    chosen, weights, population = thin(posterior, config.hypotheses)
    positions = posterior.positions[jnp.asarray(chosen)]
    opacity = opacity_grids(prior.model, likelihood, positions, observation.pose_sigma, grid=config.grid)
    pose = poses(prior.model, likelihood, positions, observation.pose_sigma)
    fit = float(weights @ np.asarray(explained(prior.model, likelihood, observation, positions), np.float64))
    seen = seen_voxels(frame, cube, config.grid)
    d = posterior.diagnostics
    draft = Hypotheses(
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        object_id=segment.id,
        label="",
        object_frame=cube,
        T_world_camera=frame.T_world_camera,
        opacity=np.asarray(opacity),
        pose=np.stack([np.asarray(a) for a in (pose.yaw, pose.x, pose.y, pose.log_scale, pose.z)], axis=-1),
        weights=weights,
        population=population,
        seen=seen,
        inside_view=_inside_picture(segment),
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
            "log_evidence": float(posterior.log_evidence),
            "log_evidence_se": float(posterior.log_evidence_se),
            "point_gradients": float(d.point_gradients) * likelihood.packed[1],
            "explained": fit,
            "power": likelihood.power,
            "evidence_power": config.infer.smc.evidence_power,
        },
        result=posterior.result,
    )
    return Estimate(_with_error(draft), posterior, likelihood, observation, cube, seconds=time.monotonic() - begun)


def _with_error(h: Hypotheses) -> Hypotheses:
    """Fill in the standard error of the mean occupancy of unseen voxels above the plane."""
    z = -1.0 + (np.arange(h.grid) + 0.5) * 2.0 / h.grid
    hidden = ~h.seen & (z > BASE_Z)
    mean = h.solid[:, hidden].mean(axis=1) if hidden.any() else np.zeros(len(h.weights))
    return replace(h, monte_carlo_error=float(h.estimate(mean)[1]))


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
