"""Answers about a region are joint over hypotheses, exact on known unions, and never call unobserved space seen."""

from dataclasses import replace

import numpy as np
import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import CAUTION, query
from perception.answers.regions import Box, Points, Swept
from perception.observation.object_frame import ObjectFrame
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import StopReason

GRID, HALF_EXTENT = 32, 0.16
VOXEL = 2 * HALF_EXTENT / GRID  # 1 cm
# In the object frame, metres: a body, and the places at its left and right where a handle may be.
BODY = ((-0.04, -0.04, -0.08), (0.04, 0.04, 0.08))
LEFT, RIGHT = ((0.04, -0.02, -0.04), (0.10, 0.02, 0.04)), ((-0.10, -0.02, -0.04), (-0.04, 0.02, 0.04))
HANDLE_M3 = 0.06 * 0.04 * 0.08


def _fill(*boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    centres = voxel_centres(GRID) * HALF_EXTENT
    inside = [np.all((centres > low) & (centres < high), axis=-1) for low, high in boxes]
    return (255 * np.any(inside, axis=0)).astype(np.uint8)


def _object(shapes: list[np.ndarray], weights: list[float], origin=(0.0, 0.0, 0.5), object_id: int = 1) -> Hypotheses:
    T_camera_object = np.eye(4)
    T_camera_object[:3, 3] = origin
    return Hypotheses(
        stamp_ns=10_000_000_000,
        frame_id="camera",
        object_id=object_id,
        label="",
        object_frame=ObjectFrame(
            T_camera_object=T_camera_object,
            half_extent=HALF_EXTENT,
            plane=np.array([0.0, 0.0, 1.0, -0.38]),
            xy_sigma=0.05,
            log_scale_sigma=0.1,
        ),
        T_world_camera=None,
        opacity=np.stack(shapes),
        pose=np.zeros((len(shapes), 5), np.float32),
        weights=np.array(weights),
        population=np.arange(len(shapes), dtype=np.int32) % 2,
        seen=np.broadcast_to(voxel_centres(GRID)[..., 1] < 0, (GRID,) * 3),
        inside_view=True,
        out_of_model=False,
        stage=1,
        monte_carlo_error=0.0,
        prior_hash="",
        seed=0,
        diagnostics=AnswerDiagnostics(),
        result=StopReason.STAGES,
    )


@pytest.fixture
def mug() -> Hypotheses:
    """A body with its handle at the left (0.3) or the right (0.7)."""
    return _object([_fill(BODY, LEFT), _fill(BODY, RIGHT)], [0.3, 0.7])


def test_a_region_is_free_jointly_not_voxel_by_voxel(mug):
    left, right = query([mug], Box(*LEFT), "object"), query([mug], Box(*RIGHT), "object")
    assert left.p_free == pytest.approx(0.7) and right.p_free == pytest.approx(0.3)
    # Two points, one at each place: the handle is surely at one of them; the product of marginals would say 0.21.
    ends = query([mug], Points(np.array([[0.07, 0.0, 0.0], [-0.07, 0.0, 0.0]])), "object")
    assert ends.p_occupied == pytest.approx([0.3, 0.7])
    assert ends.p_free == 0.0 and np.prod(1 - np.array(ends.p_occupied)) == pytest.approx(0.21)
    # Whole voxels of both places and none of the body's: above and below it there is nothing.
    around = query([mug], Box((-0.10, -0.02, 0.09), (0.10, 0.02, 0.15)), "object")
    assert around.p_free == 1.0 and around.entropy_nats == 0.0
    both = query([mug], Box((-0.10, -0.02, -0.04), (0.10, 0.02, 0.04)), "object")
    assert both.p_free == 0.0


def test_few_hypotheses_support_no_certainty_about_an_unseen_point(mug):
    """They leave the point at y > 0 free, all of them; nothing is doubtful where it was seen."""
    points = Points(np.array([[0.0, 0.07, 0.0], [0.0, -0.07, 0.0]]))
    found = query([mug], points, "object")
    n = mug.effective_hypotheses
    assert found.p_occupied == [0.0, 0.0]
    assert found.p_occupied_few == pytest.approx([1.0 / (n + 2.0), 0.0])
    one = query([mug], Points(points.points[:1]), "object")
    assert one.p_occupied_few is not None
    assert one.p_occupied_few[0] == pytest.approx(1.0 - one.p_free_few)  # as a verdict has it
    assert query([mug], Box(*LEFT), "object").p_occupied_few is None


def test_between_centres_an_unseen_point_is_linear_and_a_seen_one_is_its_voxel(mug):
    """Across the handle's outer wall (x = 0.10, p = 0.3) at y > 0; at y < 0 it was seen; below the table is nothing."""
    x = 0.10 + VOXEL * np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
    unseen, seen = (query([mug], Points(np.stack([x, 0 * x + y, 0 * x], axis=-1)), "object") for y in (0.005, -0.005))
    assert unseen.p_occupied == pytest.approx(0.3 * np.array([1.0, 0.75, 0.5, 0.25, 0.0]))
    assert seen.p_occupied == pytest.approx([0.3, 0.3, 0.0, 0.0, 0.0])
    standing = _object([_fill(((-0.04, -0.04, -0.16), (0.04, 0.04, 0.0)))], [1.0])
    at_table = query([standing], Points(np.array([[0.0, 0.02, -0.12 + k * VOXEL] for k in (0.25, 0.5)])), "object")
    assert at_table.p_occupied == pytest.approx([0.75, 1.0])


def test_volumes_are_exact_where_the_box_follows_voxels(mug):
    left = query([mug], Box(*LEFT), "object").volume_m3
    assert left == {"q05": 0.0, "q50": 0.0, "q95": pytest.approx(HANDLE_M3)}
    right = query([mug], Box(*RIGHT), "object").volume_m3
    assert right == {"q05": 0.0, "q50": pytest.approx(HANDLE_M3), "q95": pytest.approx(HANDLE_M3)}
    whole = query([mug], Box((-0.16,) * 3, (0.16,) * 3), "object").volume_m3
    # Both shapes are as large (closing rounds the corner between body and handle alike).
    expected = mug.solid.sum(axis=(1, 2, 3)) * VOXEL**3
    assert list(whole.values()) == pytest.approx(np.full(3, expected[0])) and expected[0] == expected[1]
    half = query([mug], Box((0.04, -0.02, -0.04), (0.07, 0.02, 0.04)), "object").volume_m3
    assert half["q95"] == pytest.approx(HANDLE_M3 / 2)


def test_a_box_far_larger_than_the_cube_finds_what_a_close_one_does(mug):
    close = query([mug], Box((-0.16,) * 3, (0.16,) * 3), "object")
    far = query([mug], Box((-5.0,) * 3, (5.0,) * 3), "object")
    assert far.volume_m3 == pytest.approx(close.volume_m3) and far.p_free == close.p_free == 0.0
    assert far.outside_fraction > 0.999
    assert close.outside_fraction == pytest.approx(0.03 / 0.32, abs=0.01)  # what of the cube is in the table


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sheet_thinner_than_a_voxel_is_not_missed(mug, axis):
    low, high = np.array(LEFT)
    middle = 0.5 * (low[axis] + high[axis]) + 0.1 * VOXEL
    low[axis], high[axis] = middle, middle + 1e-6
    sheet = query([mug], Box(tuple(low), tuple(high)), "object")
    assert sheet.p_free == pytest.approx(0.7)
    assert sheet.volume_m3["q95"] == pytest.approx(np.prod(high - low))


def test_unseen_and_outside_are_shares_of_the_region(mug):
    box = query([mug], Box((0.0, -0.02, 0.0), (0.32, 0.06, 0.04)), "object")  # half beyond the cube; y < 0 is seen
    assert box.outside_fraction == pytest.approx(0.5, abs=0.02)
    assert box.unseen_fraction == pytest.approx(0.5 * 0.75, abs=0.02)
    points = query([mug], Points(np.array([[0, -0.01, 0], [0, 0.01, 0], [0, 0.02, 0], [0, 0, 0.2]])), "object")
    assert (points.unseen_fraction, points.outside_fraction) == (0.5, 0.25)


def test_a_far_box_is_unobserved_not_seen(mug):
    far = query([mug], Box((2.0, 2.0, 2.0), (2.1, 2.1, 2.1)), "object")
    assert far.outside_fraction == 1.0 and far.unseen_fraction == 0.0
    assert np.isnan([far.p_free, far.p_free_se, far.p_free_few]).all() and far.verdict() == "unseen"
    assert far.as_dict()["p_free"] is None and far.volume_m3 == {"q05": 0.0, "q50": 0.0, "q95": 0.0}
    nowhere = query([mug], Points(np.full((2, 3), 9.0)), "object")
    assert nowhere.p_occupied == [0.0, 0.0] and nowhere.outside_fraction == 1.0


def test_frames_agree(mug):
    placed = replace(mug, T_world_camera=np.array([[0, -1, 0, 1.0], [1, 0, 0, 2.0], [0, 0, 1, 3.0], [0, 0, 0, 1]]))
    low, high = np.add(LEFT, [0, 0, 0.5])
    in_object, in_camera = query([placed], Box(*LEFT), "object", 0), query([placed], Box(low, high), "camera", 0)
    turned = Box((1 - high[1], 2 + low[0], 3 + low[2]), (1 - low[1], 2 + high[0], 3 + high[2]))
    in_world = query([placed], turned, "world", 0)
    for other in (in_camera, in_world):
        assert other.p_free == in_object.p_free == pytest.approx(0.7)
        assert other.volume_m3["q95"] == pytest.approx(in_object.volume_m3["q95"])
        assert other.entropy_nats == pytest.approx(in_object.entropy_nats)


def test_entropy_is_the_mean_over_voxels(mug):
    h = -0.3 * np.log(0.3) - 0.7 * np.log(0.7)
    assert query([mug], Box(*LEFT), "object").entropy_nats == pytest.approx(h)
    half = query([mug], Box((0.04, -0.02, -0.04), (0.16, 0.02, 0.04)), "object")  # as much empty space beyond it
    assert half.entropy_nats == pytest.approx(h / 2)


def test_error_effective_number_and_age(mug):
    answer = query([mug], Box(*LEFT), "object", now_ns=12_500_000_000)
    # Two populations, one hypothesis each: they disagree wholly about the left place.
    assert answer.p_free_se == pytest.approx(0.5)
    assert answer.effective_hypotheses == pytest.approx(1 / (0.3**2 + 0.7**2))
    assert answer.age_s == pytest.approx(2.5)
    assert query([mug], Box(*BODY), "object").p_free_se == 0.0


@pytest.mark.parametrize("weights", [np.full(20, 0.05), np.random.default_rng(3).dirichlet(np.ones(20))])
def test_a_volume_quantile_is_the_least_volume_that_enough_weight_does_not_exceed(weights):
    tops = np.random.default_rng(4).permutation(20) // 2  # each volume twice
    columns = [_fill(((-0.04, -0.04, -0.08), (0.04, 0.04, -0.08 + VOXEL * (top + 1)))) for top in tops]
    found = query([_object(columns, list(weights))], Box((-0.16,) * 3, (0.16,) * 3), "object").volume_m3
    volumes = 0.08 * 0.08 * VOXEL * (tops + 1.0)
    for level, value in zip((0.05, 0.5, 0.95), found.values(), strict=True):
        enough = [v for v in volumes if weights[volumes <= v].sum() >= level - 1e-9]  # rounding raises no quantile
        assert value == pytest.approx(min(enough))


def test_a_scene_is_joint_over_its_objects(mug):
    # A second mug, its handle towards the first one's: both handles may reach into the gap between them.
    other = _object([_fill(BODY, LEFT), _fill(BODY, RIGHT)], [0.4, 0.6], origin=(0.2, 0.0, 0.5), object_id=2)
    gap = Box((0.05, -0.02, 0.46), (0.15, 0.02, 0.54))
    answer = query([mug, other], gap, "camera", 0)
    assert answer.p_free == pytest.approx(0.7 * 0.4)
    se = [query([h], gap, "camera").p_free_se for h in (mug, other)]
    assert answer.p_free_se == pytest.approx(np.hypot(se[0] * 0.4, se[1] * 0.7))
    one = 0.05 * 0.04 * 0.08  # each handle reaches 5 cm into the gap
    # Volume 0, one handle or two, with probabilities 0.28, 0.54 and 0.18.
    assert answer.volume_m3 == {"q05": 0.0, "q50": pytest.approx(one), "q95": pytest.approx(2 * one)}
    point = query([mug, other], Points(np.array([[0.095, 0.0, 0.5], [0.105, 0.0, 0.5]])), "camera")
    assert point.p_occupied == pytest.approx([0.3, 0.6])
    assert answer.effective_hypotheses == pytest.approx(1 / (0.3**2 + 0.7**2))  # the fewer of the two
    assert query([mug, other], gap, "camera", 0) == answer  # seeded
    cover = query([mug, other], Box((-0.16, -0.16, 0.34), (0.36, 0.16, 0.66)), "camera")
    assert cover.outside_fraction == pytest.approx(0.03 / 0.32, abs=0.01)  # what of both cubes is in the table
    assert cover.unseen_fraction == pytest.approx(0.5 * (1 - cover.outside_fraction), abs=0.02)


def test_an_error_is_scaled_as_the_answer_that_it_is_the_error_of(mug):
    """What caution adds is no sampler's: p_free and its error shrink alike."""
    few = replace(mug, weights=np.array([0.3, 0.7]), seen=np.ones((GRID,) * 3, bool))
    boxes = [Box(*LEFT), Box((-0.1, -0.1, 0.09), (0.1, 0.1, 0.15))]  # taken by the one population, and free to both
    (taken, free), (doubted, as_free) = (
        [query([h], box, "object") for box in boxes] for h in (few, replace(few, out_of_model=True))
    )
    slope = (as_free.p_free - doubted.p_free) / (free.p_free - taken.p_free)
    assert 0.0 < slope < 1.0 and taken.p_free_se > 0.0
    assert doubted.p_free_se == pytest.approx(slope * taken.p_free_se)


def test_seen_by_one_object_is_seen(mug):
    twin = replace(mug, object_id=2, seen=np.ones((GRID,) * 3, bool))
    box = Box((-0.1, -0.1, 0.4), (0.1, 0.1, 0.6))
    assert query([mug], box, "camera").unseen_fraction == pytest.approx(0.5, abs=0.01)
    assert query([mug, twin], box, "camera").unseen_fraction == 0.0


def test_out_of_model_answers_are_cautious_about_what_was_not_seen(mug):
    doubtful = replace(mug, out_of_model=True)
    hidden = Box((-0.1, 0.05, -0.04), (0.1, 0.1, 0.04))  # all hypotheses leave it empty; y > 0 was not seen
    assert query([mug], hidden, "object").p_free == 1.0
    answer = query([doubtful], hidden, "object")
    assert answer.p_free == pytest.approx(1 - CAUTION) and answer.entropy_nats == pytest.approx(np.log(2))
    assert answer.volume_m3["q95"] == pytest.approx(0.2 * 0.05 * 0.08)
    seen = Box((-0.1, -0.1, -0.04), (0.1, -0.05, 0.04))
    assert query([doubtful], seen, "object").p_free == 1.0
    points = query([doubtful], Points(np.array([[0.0, 0.07, 0.0], [0.0, -0.07, 0.0], [0.07, 0.01, 0.0]])), "object")
    assert points.p_occupied == pytest.approx([CAUTION, 0.0, (1 - CAUTION) * 0.3 + CAUTION])


def test_the_answer_has_the_promised_keys(mug):
    keys = {
        "p_free",
        "p_free_se",
        "p_free_few",
        "volume_m3",
        "unseen_fraction",
        "outside_fraction",
        "entropy_nats",
        "effective_hypotheses",
        "age_s",
        "blocked_by",
    }
    assert query([mug], Box(*LEFT), "object").as_dict().keys() == keys
    points = query([mug], Points(np.zeros((3, 3))), "object").as_dict()
    assert points.keys() == keys | {"p_occupied", "p_occupied_few"} and points["p_occupied"] == [1.0] * 3
    assert all(isinstance(points[name], float) for name in keys - {"volume_m3", "blocked_by"})


def test_questions_that_mean_nothing_are_refused(mug):
    with pytest.raises(ValueError, match=r"y1 = 0 is not greater than y0 = 0\.5"):
        Box((0, 0.5, 0), (1, 0, 1))
    with pytest.raises(ValueError, match="not greater"):
        Box((0, 0, 0), (1, 1, 0))
    with pytest.raises(ValueError, match="not finite"):
        Box((0, 0, 0), (1, float("inf"), 1))
    with pytest.raises(ValueError, match=r"beyond 1e\+06"):  # its volume would be infinite, and never be sampled
        Box((-1e308, 0, 0), (1e308, 1, 1))
    with pytest.raises(ValueError, match=r"up to 1e\+06"):
        Points(np.array([[1e308, 0, 0]]))
    with pytest.raises(ValueError, match=r"beyond 1e\+06"):
        Swept(np.eye(4)[None], np.array([[1e308, 1.0, 1.0]]))
    with pytest.raises(ValueError, match="point 2 is"):
        Points(np.array([[0, 0, 0], [np.nan, 0, 0]]))
    with pytest.raises(ValueError, match=r"shape \[0, 3\]"):
        Points(np.zeros((0, 3)))
    box = Box(*LEFT)
    with pytest.raises(ValueError, match="without the camera's pose in the world"):
        query([mug], box, "world")
    with pytest.raises(ValueError, match="ambiguous with 2 objects"):
        query([mug, replace(mug, object_id=2)], box, "object")
    with pytest.raises(ValueError, match="objects 1 and 2 are from different frames"):
        query([mug, replace(mug, object_id=2, stamp_ns=5)], box, "camera")
    with pytest.raises(ValueError, match="no objects"):
        query([], box, "camera")


def _swept(*boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> Swept:
    """Axis-aligned boxes as swept ones."""
    low, high = np.moveaxis(np.array(boxes), 1, 0)
    T = np.tile(np.eye(4), (len(boxes), 1, 1))
    T[:, :3, 3] = 0.5 * (low + high)
    return Swept(T, high - low)


def test_swept_boxes_are_one_region(mug):
    """Both handles' places together: one of them is surely taken, whatever is swept twice counts once."""
    both = query([mug], _swept(LEFT, RIGHT, LEFT), "object")
    assert both.p_free == 0.0
    assert both.volume_m3 == pytest.approx({"q05": HANDLE_M3, "q50": HANDLE_M3, "q95": HANDLE_M3})
    assert both.unseen_fraction == pytest.approx(0.5, abs=0.02) and both.outside_fraction == 0.0
    inner, outer = ((-0.01, -0.01, -0.01), (0.01, 0.01, 0.01)), ((0.5, 0.0, 0.0), (0.52, 0.02, 0.02))
    assert query([mug], _swept(inner, outer), "object").outside_fraction == pytest.approx(0.5, abs=0.01)
    far = query([mug], _swept(outer), "object")
    assert far.verdict() == "unseen" and far.outside_fraction == 1.0 and far.entropy_nats == 0.0


def test_a_turned_thin_box_finds_its_voxels(mug):
    """A blade of 0.1 mm across the left handle, turned 45 degrees, meets it as surely as the whole handle's box."""
    T = np.eye(4)
    T[:2, :2] = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    T[:3, 3] = [0.07, 0.0, 0.0]
    assert query([mug], Swept(T[None], np.array([[0.05, 1e-4, 0.05]])), "object").p_free == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("T", "size", "complaint"),
    [
        (np.eye(4), np.ones((1, 3)), "give"),
        (np.eye(4)[None], np.zeros((1, 3)), "not longer than 0 m"),
        (np.full((1, 4, 4), np.nan), np.ones((1, 3)), "not finite"),
        (np.zeros((0, 4, 4)), np.zeros((0, 3)), "N"),
    ],
)
def test_swept_boxes_are_checked(T, size, complaint):
    with pytest.raises(ValueError, match=complaint):
        Swept(T, size)
