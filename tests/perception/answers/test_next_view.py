"""The next view: nothing is gained where all hypotheses look alike, and log 2 where two are told apart."""

from dataclasses import replace

import numpy as np
import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.answers.next_view import first_hits, packed, rank_views, ring_of_views
from perception.observation.object_frame import ObjectFrame
from probnerf.geometry import look_at
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import StopReason

GRID, HALF_EXTENT, DISTANCE = 32, 0.16, 0.6
PRESENT = look_at(np.array([DISTANCE, 0.0, 0.0]), np.zeros(3))  # the camera looks from +x
CENTRES = voxel_centres(GRID)
BODY = np.linalg.norm(CENTRES[..., :2], axis=-1) < 0.45
BEHIND = (CENTRES[..., 0] < -0.4) & (CENTRES[..., 0] > -0.8) & (np.abs(CENTRES[..., 1:]) < 0.2).all(axis=-1)
BEHIND = np.asarray(BEHIND)


def object_of(*shapes: np.ndarray, weights: list[float], object_id: int = 1) -> Hypotheses:
    return Hypotheses(
        stamp_ns=1,
        frame_id="camera",
        object_id=object_id,
        label="",
        object_frame=ObjectFrame(np.linalg.inv(PRESENT), HALF_EXTENT, np.array([0.0, 0.0, 1.0, 0.12]), 0.05, 0.1),
        T_world_camera=None,
        opacity=(255 * np.stack(shapes)).astype(np.uint8),
        pose=np.zeros((len(shapes), 5), np.float32),
        weights=np.array(weights),
        population=np.zeros(len(shapes), np.int32),
        seen=np.zeros((GRID,) * 3, bool),
        inside_view=True,
        out_of_model=False,
        stage=1,
        monte_carlo_error=0.0,
        prior_hash="",
        seed=0,
        diagnostics=AnswerDiagnostics(),
        result=StopReason.STAGES,
    )


HIDDEN = object_of(BODY, BODY | BEHIND, weights=[0.5, 0.5])


def from_azimuth(degrees: float, elevation: float = 20.0) -> np.ndarray:
    a, e = np.radians(degrees), np.radians(elevation)
    at = DISTANCE * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return look_at(at, np.zeros(3))


def test_a_part_behind_the_body_is_told_from_the_side_and_not_from_the_front() -> None:
    cameras = np.stack([PRESENT, from_azimuth(90.0), from_azimuth(-90.0), from_azimuth(180.0)])
    ranked = rank_views([HIDDEN], cameras, count=4)
    assert np.array_equal(ranked.T_object_camera[-1], PRESENT)
    assert ranked.gain_nats[-1] == pytest.approx(0.0, abs=1e-9)
    assert np.allclose(ranked.gain_nats[:3], np.log(2.0), atol=0.01)
    assert ranked.entropy_nats == pytest.approx(np.log(2.0))


def test_gain_lies_between_nothing_and_the_entropy_of_the_weights() -> None:
    rng = np.random.default_rng(0)
    shapes = [BODY | np.roll(BEHIND, rng.integers(-3, 4, 3), (0, 1, 2)) for _ in range(6)]
    w = rng.dirichlet(np.ones(6))
    ranked = rank_views([object_of(*shapes, weights=list(w))], count=100)
    assert len(ranked.gain_nats) == 36
    assert (np.diff(ranked.gain_nats) <= 0).all()
    assert ranked.gain_nats.min() >= 0 and ranked.gain_nats.max() <= ranked.entropy_nats + 1e-9


def test_copies_of_one_shape_leave_nothing_to_gain() -> None:
    ranked = rank_views([object_of(BODY, BODY, BODY, weights=[0.2, 0.3, 0.5])])
    assert np.allclose(ranked.gain_nats, 0.0, atol=1e-9) and ranked.entropy_nats == pytest.approx(0.0)


def test_gains_of_independent_objects_add() -> None:
    one = rank_views([HIDDEN], count=36)
    two = rank_views([HIDDEN, replace(HIDDEN, object_id=2)], count=36)
    assert np.allclose(two.gain_nats, 2.0 * one.gain_nats)


def test_a_ray_meets_each_hypothesis_where_its_voxels_begin() -> None:
    """Against a walk along the ray in small steps, and with more hypotheses than bits in a word."""
    rng = np.random.default_rng(1)
    h = object_of(*[rng.random((GRID,) * 3) < 0.02 for _ in range(70)], weights=[1 / 70] * 70)
    origin = np.array([[2.0, 0.3, 0.1], [0.2, -2.0, 0.4], [0.0, 0.0, 3.0]])
    direction = -origin / np.linalg.norm(origin, axis=1, keepdims=True)
    words = packed(h.solid)
    found = np.concatenate([first_hits(words, 70, o, d[None]) for o, d in zip(origin, direction, strict=True)])
    t = np.arange(0.0, 6.0, 1e-3)
    for ray in range(3):
        p = origin[ray] + t[:, None] * direction[ray]
        index = np.floor((p + 1.0) * GRID / 2).astype(int)
        inside = ((index >= 0) & (index < GRID)).all(axis=1)
        i, j, k = np.where(inside[:, None], index, 0).T
        for s in range(0, 70, 7):
            walked = h.solid[s][i, j, k] & inside
            first = t[walked.argmax()] if walked.any() else np.inf
            # a corner that the ray cuts by less than a voxel may be stepped over
            assert found[ray, s] >= first - 2.0 / GRID
            if np.isfinite(found[ray, s]):
                at = np.floor((origin[ray] + found[ray, s] * direction[ray] + 1.0) * GRID / 2).astype(int)
                assert h.solid[s][tuple(at)]


def test_the_ring_looks_at_the_object_from_the_present_distance() -> None:
    views = ring_of_views(HIDDEN)
    assert np.allclose(np.linalg.norm(views[:, :3, 3], axis=1), DISTANCE)
    assert np.allclose(views[:, :3, 2], -views[:, :3, 3] / DISTANCE)
    assert (views[:, 2, 3] > 0).all()


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        (np.eye(4), "shape"),
        (np.full((1, 4, 4), np.nan), "rigid"),
        (2 * np.eye(4)[None], "rigid"),
        (np.eye(4)[None], "candidate camera 1 is at the centre of object 1"),
    ],
)
def test_a_camera_that_is_none_is_refused(cameras: np.ndarray, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        rank_views([HIDDEN], cameras)


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(ValueError, match="no objects"):
        rank_views([])


def test_objects_of_different_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="objects 1 and 2 are from different frames"):
        rank_views([HIDDEN, replace(HIDDEN, object_id=2, stamp_ns=5)])
