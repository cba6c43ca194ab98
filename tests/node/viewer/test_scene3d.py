"""What the page shows lies where the hypotheses do, and says what a query says."""

from dataclasses import replace

import numpy as np
import pytest

from node.figures.voxel_renderer import STATUS
from node.viewer import panel, scene3d
from perception.answers.hypotheses import Hypotheses, mesh
from perception.answers.query import query
from perception.answers.regions import Box, Points
from perception.observation.segmentation import segment
from perception.sources.frame import Frame
from probnerf.pixel_status import OBJECT
from probnerf.types import BASE_Z, StopReason
from tests.node.mugs import mug_hypotheses, table_frame


@pytest.fixture(scope="module")
def frame() -> Frame:
    return replace(table_frame(), T_world_camera=None)


@pytest.fixture(scope="module")
def mug(frame: Frame) -> Hypotheses:
    return mug_hypotheses(frame, segment(frame, 1)[0], [2.0, -2.0, 2.0], [0.5, 0.3, 0.2])


@pytest.fixture(scope="module")
def scene(frame: Frame, mug: Hypotheses) -> list[Hypotheses]:
    """The mug and, where the carton stands, the same mug again."""
    return [mug, mug_hypotheses(frame, segment(frame, 2)[0], [1.0, -1.0], [0.6, 0.4])]


def world(h: Hypotheses) -> Hypotheses:
    """As seen by a camera that knows its place, far from the origin and turned."""
    T = np.array([[0.0, 0.6, 0.8, 5.0], [1.0, 0.0, 0.0, -3.0], [0.0, 0.8, -0.6, 2.0], [0.0, 0.0, 0.0, 1.0]])
    return replace(h, T_world_camera=T)


def test_the_page_frame_is_the_world_or_an_object(scene: list[Hypotheses]) -> None:
    single = scene3d.place(scene[:1])
    assert (single.frame, single.title) == ("object", "object 1")
    np.testing.assert_array_equal(single.T_page_object(scene[0]), np.eye(4))
    several = scene3d.place(scene)
    assert several.title == "object 1"
    np.testing.assert_allclose(several.T_page_object(several.objects[0]), np.eye(4), atol=1e-12)
    known = scene3d.place([world(h) for h in scene])
    assert known.title == "world"
    T = known.T_page_camera @ scene[1].object_frame.T_camera_object
    np.testing.assert_allclose(known.T_page_object(known.objects[1]), T, atol=1e-12)
    with pytest.raises(ValueError, match="no object to show"):
        scene3d.place([])
    with pytest.raises(ValueError, match="different frames"):
        scene3d.place([scene[0], replace(scene[1], stamp_ns=7)])


@pytest.mark.parametrize("place", ["alone", "together", "world"])
def test_meshes_lie_where_the_camera_sees_them(scene: list[Hypotheses], frame: Frame, place: str) -> None:
    """The points that the depth measured on the mug lie on its mesh, in whatever frame the page has."""
    known = [world(h) for h in scene] if place == "world" else scene
    placed = scene3d.place(known[:1] if place == "alone" else known)
    h = placed.objects[0]
    found = scene3d.shape(placed, h, 0)
    vertices, faces = mesh(h, 0)
    camera = scene3d.transform(h.object_frame.T_camera_object, vertices)
    np.testing.assert_allclose(found.vertices, scene3d.transform(placed.T_page_camera, camera), atol=1e-9)
    assert len(found.seen) + len(found.unseen) == len(faces) and len(found.seen) and len(found.unseen)
    view = scene3d.camera_view(frame, known)
    points, colours = scene3d.seen_surface(placed, view)
    assert points.shape == colours.shape and colours.dtype == np.uint8
    own = view.segments[1].status.ravel() == OBJECT
    own = own & np.isfinite(frame.depth.ravel())
    rays = frame.camera.rays(np.argwhere(own.reshape(frame.depth.shape))[:, ::-1])
    on_mug = rays / rays[:, 2:] * frame.depth.ravel()[own][:, None]
    gap = scene3d.transform(placed.T_page_camera, on_mug)[::20, None] - found.vertices[np.unique(found.seen)][None]
    assert np.median(np.linalg.norm(gap, axis=-1).min(axis=1)) < 1.2 * h.voxel_m


def test_the_camera_saw_what_faces_it(mug: Hypotheses) -> None:
    placed = scene3d.place([mug])
    found = scene3d.shape(placed, mug, 0)
    towards = placed.T_page_camera[:3, 3] / np.linalg.norm(placed.T_page_camera[:3, 3])

    def facing(faces: np.ndarray) -> np.ndarray:
        a, b, c = (found.vertices[faces[:, i]] for i in range(3))
        return np.cross(b - a, c - a) @ towards > 0

    assert facing(found.seen).mean() > 0.75 and facing(found.unseen).mean() < 0.4


def test_the_cloud_says_what_a_query_says(scene: list[Hypotheses]) -> None:
    for known, name in ((scene[:1], "object"), ([world(h) for h in scene], "world")):
        placed = scene3d.place(known)
        cloud = scene3d.cloud(placed)
        np.testing.assert_array_equal(cloud.p_occupied, query(known, Points(cloud.points), name).p_occupied)
        assert (cloud.p_occupied >= scene3d.LEAST_P).all() and cloud.disagreement.max() <= 1 + 1e-12
        assert query(known, Points(cloud.points), name).unseen_fraction > 0 and len(cloud.points) > 100
    single = scene3d.cloud(scene3d.place(scene[:1]))
    h = scene[0]
    hidden = ~h.seen & (h.p_occupied >= scene3d.LEAST_P)
    z = -1.0 + (np.arange(h.grid) + 0.5) * 2.0 / h.grid
    assert len(single.points) == (hidden & (z >= BASE_Z)).sum()
    np.testing.assert_allclose(np.sort(single.p_occupied), np.sort(h.p_occupied[hidden & (z >= BASE_Z)]), atol=1e-12)


def test_a_box_is_asked_as_a_query_asks_it(scene: list[Hypotheses]) -> None:
    centre, size = np.array([-0.02, 0.03, 0.01]), np.array([0.03, 0.02, 0.05])
    box = Box(tuple(centre - size / 2), tuple(centre + size / 2))
    mine = scene3d.ask(scene3d.place(scene[:1]), centre, size)
    direct = query(scene[:1], box, "object")
    assert replace(mine, age_s=0) == replace(direct, age_s=0) and 0 < direct.volume_m3["q95"]
    known = [world(h) for h in scene]
    middle = scene3d.place(known).T_page_object(known[0])[:3, 3]
    mine = scene3d.ask(scene3d.place(known), middle, size)
    direct = query(known, Box(tuple(middle - size / 2), tuple(middle + size / 2)), "world")
    assert replace(mine, age_s=0) == replace(direct, age_s=0) and direct.outside_fraction == 0
    # Of several objects whose place in the world is not known, a box about the first alone asks of the first alone.
    together, alone = (scene3d.ask(scene3d.place(s), np.zeros(3), 0.5 * size).volume_m3 for s in (scene, scene[:1]))
    np.testing.assert_allclose(list(together.values()), list(alone.values()), rtol=0.15)


def test_the_first_box_is_worth_asking(mug: Hypotheses) -> None:
    placed = scene3d.place([mug])
    centre, size = scene3d.first_box(placed, scene3d.cloud(placed))
    result = scene3d.ask(placed, centre, size)
    assert 0.2 < result.p_free < 0.8 and result.outside_fraction == 0
    nothing = replace(mug, seen=np.ones_like(mug.seen))
    cloud = scene3d.cloud(scene3d.place([nothing]))
    assert len(cloud.points) == 0 and scene3d.first_box(scene3d.place([nothing]), cloud)[1].min() > 0


def test_weights_are_those_of_distinct_shapes(mug: Hypotheses) -> None:
    order, weights = scene3d.weights_in_order(mug)
    assert order.tolist() == [0, 1] and weights == pytest.approx([0.7, 0.3])


def test_the_picture_is_tinted_by_status(frame: Frame, scene: list[Hypotheses]) -> None:
    view = scene3d.camera_view(frame, scene)
    np.testing.assert_array_equal(scene3d.picture(view, 1, False), frame.rgb)
    tinted = scene3d.picture(view, 1, True).astype(float)
    status, grey = view.segments[1].status, frame.rgb.mean(axis=2)
    for value, (_, colour) in STATUS.items():
        own = status == value
        expected = 0.5 * grey[own][:, None] + 0.5 * np.array(panel.rgb(colour))
        np.testing.assert_allclose(tinted[own], expected, atol=0.51)
    with pytest.raises(ValueError, match="the frame beside it is 'camera_color_optical_frame' at"):
        scene3d.camera_view(frame, [replace(scene[0], frame_id="other")])


@pytest.mark.parametrize("ids", [(1, 2), (2, 1), (7, 9)])
def test_pixels_belong_to_the_object_at_their_place(
    frame: Frame, scene: list[Hypotheses], ids: tuple[int, int]
) -> None:
    """Without a label map segments are numbered by size, and objects by whoever tracks them."""
    labels, unlabelled = frame.label, replace(frame, label=None)
    named = [replace(h, object_id=name) for h, name in zip(scene, ids, strict=True)]
    for shown in (named, named[::-1], named[1:]):
        segments = scene3d.camera_view(unlabelled, shown).segments
        assert segments.keys() == {h.object_id for h in shown}
        for label, h in zip((1, 2), named, strict=True):
            if h.object_id in segments:
                found = segments[h.object_id]
                assert found.id == h.object_id and (labels[found.mask] == label).mean() > 0.95
    away = replace(scene[0].object_frame, T_camera_object=scene[0].object_frame.T_camera_object + 0.3 * np.eye(4, k=3))
    assert scene3d.camera_view(unlabelled, [replace(scene[0], object_frame=away)]).segments == {}


def test_a_frame_without_depth_has_no_seen_points(frame: Frame, mug: Hypotheses) -> None:
    view = scene3d.camera_view(replace(frame, depth=None), [mug])
    points, colours = scene3d.seen_surface(scene3d.place([mug]), view)
    assert points.shape == colours.shape == (0, 3) and colours.dtype == np.uint8


def test_words_are_plain(mug: Hypotheses) -> None:
    now = mug.stamp_ns + 90 * 10**9
    said = panel.state([mug], now)
    assert "no doubts" in said and "stage 7" in said and "the sampler finished" in said and "0.010" in said
    odd = replace(mug, out_of_model=True, label="<b>", result=StopReason.BUDGET, inside_view=False)
    said = panel.state([odd], now)
    assert "OUT OF MODEL" in said and "cuts the object off" in said and "time was up" in said
    assert "<b></b>" not in said and "&lt;b&gt;" in said
    stamp = 10**18
    ages = {0.3: "0.3 s old", 150: "2 minutes old", 7200: "2 hours old", 10**6: "12 days old"}
    assert {s: panel.age(stamp, stamp + round(s * 1e9)) for s in ages} == ages
    assert panel.age(0) == "a frame without a time"
    result = scene3d.ask(scene3d.place([mug]), np.zeros(3), np.full(3, 0.01))
    said = panel.answer(result, np.zeros(3), np.full(3, 0.01), "object 1")
    assert panel.odds(result) in said and "--box -0.005 -0.005 -0.005 0.005 0.005 0.005" in said
    free, blocked = replace(result, p_free_few=0.99), replace(result, p_free_few=0.01)
    unseen = replace(result, p_free=np.nan, outside_fraction=1.0)
    assert [panel.paint(r) for r in (blocked, free)] == [panel.BLOCKED, panel.FREE]
    assert "unseen" in panel.odds(unseen) and panel.paint(unseen) not in (panel.BLOCKED, panel.FREE)


def test_colours_run_along_their_ramp() -> None:
    ramp = ("#000000", "#ff0000", "#ffff00")
    np.testing.assert_array_equal(
        scene3d.colours(np.array([-1.0, 0.0, 0.25, 0.5, 1.0, 2.0]), ramp),
        [[0, 0, 0], [0, 0, 0], [128, 0, 0], [255, 0, 0], [255, 255, 0], [255, 255, 0]],
    )
