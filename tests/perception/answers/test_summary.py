"""Size, hidden parts and next view of bodies whose shape is known."""

from dataclasses import replace

import numpy as np
import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.answers.summary import Direction, next_view, size, sticks_out, summarise, undecided
from perception.observation.object_frame import ObjectFrame
from probnerf.geometry import look_at
from probnerf.rendering.occupancy import voxel_centres

GRID, HALF_EXTENT = 32, 0.16  # a voxel is 1 cm
BODY = ((-0.04, -0.05, -0.12), (0.04, 0.05, 0.02))  # m; 8 cm deep, 10 cm wide, 14 cm high
BACK = ((-0.09, -0.01, -0.08), (-0.04, 0.01, -0.02))  # a handle behind it
SIDE = ((-0.04, -0.11, -0.08), (-0.01, -0.05, -0.02))  # beside it, on the far half


def bodies(parts: list[list[tuple]], weights: list[float], x: float = 0.0, **changes) -> Hypotheses:
    """Shapes of boxes, moved by `x` (m) towards the camera, at +x and above; the half that faces it was seen."""
    centres = voxel_centres(GRID) * HALF_EXTENT - [x, 0.0, 0.0]
    shapes = [
        np.any([np.all((centres > low) & (centres < high), axis=-1) for low, high in boxes], axis=0) for boxes in parts
    ]
    T_object_camera = look_at(np.array([0.5, 0.0, 0.3]), np.zeros(3)).astype(np.float64)
    pose = np.zeros((len(parts), 5), np.float32)
    pose[:, 1] = x / HALF_EXTENT
    fields = {
        "stamp_ns": 1,
        "frame_id": "camera",
        "object_id": 1,
        "label": "",
        "object_frame": ObjectFrame(np.linalg.inv(T_object_camera), HALF_EXTENT, np.array([0, 0, 1.0, 0]), 0.05, 0.1),
        "T_world_camera": None,
        "opacity": (255 * np.stack(shapes)).astype(np.uint8),
        "pose": pose,
        "weights": np.array(weights),
        "population": np.arange(len(parts)),
        "seen": centres[..., 0] > 0.0,
        "inside_view": True,
        "out_of_model": False,
        "stage": 1,
        "monte_carlo_error": 0.01,
        "prior_hash": "",
        "seed": 0,
        "diagnostics": AnswerDiagnostics(),
        "result": "converged",
    }
    return Hypotheses(**{**fields, **changes})


def test_size_is_the_weighted_median_of_the_shapes() -> None:
    wide = ((-0.04, -0.08, -0.12), (0.04, 0.08, 0.02))
    assert size(bodies([[BODY], [wide]], [0.6, 0.4])) == pytest.approx([0.10, 0.08, 0.14])
    assert size(bodies([[BODY], [wide]], [0.4, 0.6])) == pytest.approx([0.16, 0.08, 0.14])


def test_what_is_undecided_is_where_shapes_disagree() -> None:
    part = undecided(bodies([[BODY], [BODY, BACK]], [0.6, 0.4]))
    assert part is not None and part.side == "back"
    assert part.volume_m3 == pytest.approx(0.05 * 0.02 * 0.06)
    assert undecided(bodies([[BODY], [BODY, BACK]], [0.9, 0.1])) is None  # decided, nearly
    thicker = ((-0.05, -0.05, -0.12), (0.04, 0.05, 0.02))
    assert undecided(bodies([[BODY], [thicker]], [0.5, 0.5])) is None  # a wall within a voxel
    tube = [((-0.04, -0.05, -0.12), (0.04, -0.03, 0.02)), ((-0.04, 0.03, -0.12), (0.04, 0.05, 0.02))]
    inside = undecided(bodies([[BODY], tube], [0.5, 0.5], seen=np.zeros((GRID,) * 3, bool)))
    assert inside is not None and inside.side is None


def test_a_handle_behind_in_half_of_the_weight_is_a_chance_of_a_half() -> None:
    h = bodies([[BODY, BACK], [BODY]], [0.5, 0.5])
    assert sticks_out(h).tolist() == [True, False]
    summary = summarise(h)
    assert summary.p_sticks_out == pytest.approx(0.5) and summary.p_sticks_out_se > 0.0
    assert summarise(replace(h, out_of_model=True)).p_sticks_out == pytest.approx(0.75)


def test_the_far_side_of_the_body_does_not_stick_out() -> None:
    """Wherever the body stands: its own axis is the mirror. A part counts once it is farther out than the margin."""
    for x in (0.0, 0.03, -0.03):
        assert not sticks_out(bodies([[BODY]], [1.0], x)).any()
        assert sticks_out(bodies([[BODY, BACK]], [1.0], x)).all()
    deeper = ((-0.06, -0.05, -0.12), (0.04, 0.05, 0.02))
    h = bodies([[deeper]], [1.0])
    assert sticks_out(h, 0.01).all() and not sticks_out(h, 0.02).any()


def test_a_part_that_was_seen_does_not_count() -> None:
    h = bodies([[BODY, SIDE]], [1.0])
    assert sticks_out(h).all()
    assert not sticks_out(replace(h, seen=np.ones_like(h.seen))).any()
    assert sticks_out(replace(h, seen=np.zeros_like(h.seen))).all()  # nothing was seen: all of it is beyond


def test_agreement_of_few_hypotheses_is_no_certainty() -> None:
    assert summarise(bodies([[BODY], [BODY, BACK]], [0.5, 0.5])).p_least == pytest.approx(0.25)
    assert summarise(bodies([[BODY]] * 8, [0.125] * 8)).p_least == pytest.approx(1.0 / 3.0)  # all are the same one


def test_the_next_view_is_on_the_side_of_the_doubt() -> None:
    behind = next_view(bodies([[BODY, BACK], [BODY]], [0.5, 0.5]))
    assert behind is not None and behind.side != "front" and behind.gain_nats > 0.1
    assert next_view(bodies([[BODY]], [1.0])) is None  # nothing left to tell apart


def test_left_and_right_are_the_picture_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """+y of the object frame is to the right of a camera at +x."""
    from perception.answers import summary
    from perception.answers.next_view import RankedViews

    h = bodies([[BODY]], [1.0])
    right = np.linalg.inv(h.object_frame.T_camera_object)[:3, 0]  # the camera's x axis in the object frame
    places = {"right": 0.5 * right, "left": -0.5 * right, "back": np.array([-0.5, 0.0, 0.1])}
    for side, place in places.items():
        T = look_at(place, np.zeros(3))[None]
        monkeypatch.setattr(summary, "rank_views", lambda *_, T=T, **__: RankedViews(T, np.array([0.5]), 0.7))
        assert next_view(h) == Direction(side, False, 0.5)
