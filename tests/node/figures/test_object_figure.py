"""What the pictures show is where it should be; a PNG appears whole."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from node.figures import voxel_renderer
from node.figures.object_figure import draw_object, draw_training, representatives
from node.figures.summary import answer, diagnostics, figures, hidden_volume, warnings
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.answers.summary import Direction, Summary
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import segment
from perception.sources.frame import Frame
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import StopReason
from tests.node.mugs import mug_hypotheses, table_frame

GRID = 32
LEFT, RIGHT = 0.6 * np.pi, -0.6 * np.pi


@pytest.fixture(scope="module")
def frame() -> Frame:
    return table_frame()


@pytest.fixture(scope="module")
def mug(frame: Frame) -> Hypotheses:
    return mug_hypotheses(frame, segment(frame, 1)[0], [LEFT, RIGHT, LEFT, np.pi], [0.3, 0.25, 0.2, 0.25], GRID)


def a_cube_frame(camera: tuple[float, float, float] = (3.0, 0.0, 2.0)) -> ObjectFrame:
    """One metre per cube unit; the camera looks at the cube's centre."""
    T = np.linalg.inv(voxel_renderer.look_at(np.array(camera), np.zeros(3)))
    return ObjectFrame(T, 1.0, np.array([0.0, 0.0, 1.0, 0.0]), 0.1, 0.1)


def test_marching_meets_a_ball_where_it_is() -> None:
    """Distances and normals of a ball's surface, to half a voxel and a few degrees."""
    centre, radius = np.array([0.1, -0.2, 0.05]), 0.5
    solid = np.linalg.norm(voxel_centres(64) - centre, axis=-1) < radius
    view = voxel_renderer.viewpoint(a_cube_frame(), 41)
    assert view.origin == pytest.approx([3.0, 0.0, 2.0])
    t, normals = voxel_renderer.march(solid, view)
    towards = view.directions @ (centre - view.origin)
    miss = np.linalg.norm(centre - view.origin - towards[:, None] * view.directions, axis=1)
    assert np.isfinite(t[miss < 0.95 * radius]).all() and np.isinf(t[miss > 1.1 * radius]).all()
    safe = miss < 0.8 * radius
    exact = towards[safe] - np.sqrt(radius**2 - miss[safe] ** 2)
    assert np.abs(t[safe] - exact).max() < 0.025
    points = view.origin + exact[:, None] * view.directions[safe]
    assert np.einsum("ij,ij->i", normals[safe], (points - centre) / radius).min() > np.cos(np.deg2rad(15))


def test_the_far_viewpoint_is_opposite_and_not_too_high() -> None:
    for camera, elevation in (((3.0, 1.0, 0.5), None), ((1.0, 0.5, 3.0), 35.0)):
        front, back = (voxel_renderer.viewpoint(a_cube_frame(camera), 8, behind).origin for behind in (False, True))
        assert np.linalg.norm(back) == pytest.approx(np.linalg.norm(front))
        assert back[:2] @ front[:2] == pytest.approx(-np.linalg.norm(back[:2]) * np.linalg.norm(front[:2]))
        assert np.degrees(np.arcsin(back[2] / np.linalg.norm(back))) == pytest.approx(
            elevation or np.degrees(np.arcsin(front[2] / np.linalg.norm(front)))
        )


def test_the_crop_and_the_shapes_share_pixels(frame: Frame, mug: Hypotheses) -> None:
    """The mug's mask, looked up, covers the shaded mug's pixels."""
    view = voxel_renderer.viewpoint(mug.object_frame, 64)
    mask = voxel_renderer.look_up((frame.label == 1).astype(np.uint8), frame.camera, mug.object_frame, view, 0) > 0
    hit = np.isfinite(voxel_renderer.march(mug.solid[3], view)[0]).reshape(64, 64)  # its handle points away
    assert (mask & hit).sum() > 0.88 * (mask | hit).sum()
    rgb = voxel_renderer.look_up(frame.rgb, frame.camera, mug.object_frame, view, 255)
    assert rgb.shape == (64, 64, 3) and rgb.dtype == np.uint8


def test_surface_out_of_sight_is_orange(mug: Hypotheses) -> None:
    front, back = (voxel_renderer.viewpoint(mug.object_frame, 64, behind) for behind in (False, True))
    share = []
    for view in (front, back):
        picture = voxel_renderer.shade(mug, mug.solid[3], view)
        on = np.isfinite(voxel_renderer.march(mug.solid[3], view)[0]).reshape(64, 64)
        share.append((picture[on][:, 0] > 1.2 * picture[on][:, 2]).mean())
    assert share[0] < 0.25 and share[1] > 0.7


def test_the_largest_along_a_line_of_sight() -> None:
    values = np.zeros((GRID, GRID, GRID))
    values[4, 16, 16], values[20, 16, 16] = 0.3, 0.9
    image = voxel_renderer.largest_along(values, voxel_renderer.viewpoint(a_cube_frame((3.0, 0.0, 0.01)), 65))
    assert image.max() == 0.9 and (image > 0).mean() < 0.02


def test_representatives_stand_for_all_the_weight(mug: Hypotheses) -> None:
    chosen, shares = representatives(mug.solid, mug.weights, 4)
    assert len(chosen) == 3  # two are copies
    assert shares == pytest.approx([0.5, 0.25, 0.25]) and chosen[0] in (0, 2)
    chosen, shares = representatives(mug.solid, mug.weights, 2)
    assert len(chosen) == 2 and shares.sum() == pytest.approx(1.0) and (np.diff(shares) <= 0).all()


def test_the_pictures_are_written_whole(tmp_path: Path, frame: Frame, mug: Hypotheses) -> None:
    found = segment(frame, 1)[0]
    draw_object(tmp_path / "new" / "a.png", mug, frame, found)
    draw_object(tmp_path / "new" / "b.png", replace(mug, out_of_model=True, inside_view=False, label="mug"))
    history = [{"step": 50 * i, "rays": i > 20, "loss": 1000.0 / i, "fit": -900.0 / i, "kl": 5.0} for i in range(1, 60)]
    draw_training(tmp_path / "new" / "c.png", history)
    draw_training(tmp_path / "new" / "d.png", history[:1])
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["a.png", "b.png", "c.png", "d.png"]
    with_view, without = (cv2.imread(str(tmp_path / "new" / name)) for name in ("a.png", "b.png"))
    assert with_view.shape == without.shape == (990, 1550, 3)
    assert not np.array_equal(with_view[:600, :300], without[:600, :300])


def test_the_short_table_tells_the_unseen(mug: Hypotheses) -> None:
    space, (low, middle, high) = hidden_volume(mug)
    hidden = ~mug.seen & (voxel_centres(GRID)[..., 2] > -0.75)
    assert space == pytest.approx(hidden.sum() * mug.voxel_m**3)
    assert 0 < low <= middle <= high < space
    rows = {**figures(mug), **diagnostics(mug)}
    assert rows["log evidence"] == "-321.5 ± 0.5 nats" and rows["stopped"] == "converged, stage 7"
    assert "cm³" in rows["undecided"] and "(25 to 75%)" in rows["undecided"]
    assert rows["hypotheses"].startswith("4 (2.7") and "cm³" in rows["solid in it"]
    assert diagnostics(replace(mug, diagnostics=AnswerDiagnostics()))["log evidence"] == "none"


def test_warnings_are_about_what_the_user_can_change(mug: Hypotheses) -> None:
    assert not warnings(mug)
    assert not warnings(replace(mug, diagnostics=AnswerDiagnostics(divergences=2.0, r_hat=1.3)))  # numbers, not doubts
    assert len(warnings(replace(mug, out_of_model=True, inside_view=False))) == 2
    lost = AnswerDiagnostics(failed_populations=3.0)
    (line,) = warnings(replace(mug, population=np.zeros_like(mug.population), diagnostics=lost))
    assert line.startswith("the answer rests on one of 4 populations") and "take another view" in line
    assert not warnings(replace(mug, population=np.arange(len(mug.weights)) % 2, diagnostics=lost))
    (line,) = warnings(replace(mug, result=StopReason.BUDGET))
    assert line.startswith("the time was up") and "raise the budget" in line
    (line,) = warnings(replace(mug, out_of_model=True))
    assert line.startswith("out of model: no shape of the prior")
    (line,) = warnings(replace(mug, out_of_model=True, result=StopReason.BUDGET))  # time may be all that it lacked
    assert "cut short (budget); give it more time" in line and "out of model" not in line


def test_the_answer_is_a_sentence_to_act_on() -> None:
    summary = Summary(np.array([0.087, 0.09, 0.098]), 0.31, 0.05, 0.02, Direction("left", False, 0.4))
    assert answer(summary) == (
        "about 9 × 9 × 10 cm (width, depth, height); 31% chance that an unseen part reaches more than 1 cm beyond what "
        "was seen; look next from the left"
    )
    assert "; less than 2% chance" in answer(replace(summary, p_sticks_out=0.0))
    assert answer(replace(summary, next_view=Direction("back", True, 0.4))).endswith("from above and behind")
    what = {"vessel": 0.012, "box": 0.004, "other": 0.984}
    assert answer(replace(summary, kinds=what)).startswith("other 98%, vessel 1%; about")
    assert answer(replace(summary, next_view=None)).endswith("another view would tell little")
