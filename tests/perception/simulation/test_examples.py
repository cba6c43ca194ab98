"""Examples tell the truth: a mesh at the told pose lies on what the sensor measured, and as much is hidden as asked."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from perception.observation.segmentation import backproject
from perception.simulation.examples import Example, draw_examples, example_of
from perception.simulation.mesh_scene import MeshScene, MeshShape, PlacedMesh, render_meshes
from perception.simulation.sensor_faults import SensorConfig, sense
from perception.simulation.view_draws import ViewDraws, box_shape, draw_view, hidden_share
from perception.sources.frame import Frame
from probnerf.likelihood.position import pose_of

pytest.importorskip("embreex")
SIDES = np.array([0.10, 0.06, 0.08])
SHAPE = box_shape(SIDES, np.array([0.7, 0.4, 0.2]))
ALONE = ViewDraws((300.0, 300.0), elevation=(25.0, 50.0), distance=(0.45, 0.55), beside=0.0, before=0.0, border=0.0)
BIASED = SensorConfig(noise=0.0005, noise_z2=0.0, bias=(0.004, 0.0, 0.0))


def told(example: Example, points: np.ndarray) -> np.ndarray:
    """Points of the camera frame (m) in the object's own cube, by the pose that the example tells."""
    pose = pose_of(jnp.asarray(example.pose), jnp.asarray(example.pose_sigma))
    return np.asarray(pose.to_object(example.cube.to_cube(points))) * example.half_extent


def beside_surface(points: np.ndarray) -> np.ndarray:
    """Distance (m) of points in the object's own frame to the box's surface, in the largest norm."""
    low = -0.75 * SHAPE.half_extent
    return np.abs(np.abs(points - [0, 0, low + SIDES[2] / 2]) - SIDES / 2).min(axis=1)


def accepted(answer: Example | str) -> Example:
    assert isinstance(answer, Example), answer
    return answer


def view_of(seed: int) -> tuple[Frame, PlacedMesh, np.ndarray]:
    view = draw_view(np.random.default_rng(seed), SHAPE, draws=ALONE)
    picture = render_meshes(view.scene, view.camera, view.T_world_camera)
    return sense(picture, view.camera, view.T_world_camera, seed, BIASED), view.target, picture.depth


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("own_mask", [False, True])
def test_the_told_pose_puts_the_mesh_on_the_measured_points(seed: int, own_mask: bool) -> None:
    """The bias moves the table with the object, so it is no error of the pose's; it is the range offset."""
    frame, placed, depth = view_of(seed)
    example = example_of(frame, placed, 64, np.random.default_rng(0), true_depth=depth, own_mask=own_mask)
    assert isinstance(example, Example) and example.depth
    inner = (frame.label == 1) & np.isfinite(frame.depth)
    points = backproject(Frame(frame.rgb, depth, frame.camera))[inner]
    assert np.percentile(beside_surface(told(example, points)), 95) < 0.004  # the plane's tilt by the sensor's bias
    offset = example.pose[5] * example.pose_sigma[3] * example.cube.half_extent
    assert 0.004 <= offset < 0.0055  # along the ray
    assert np.hypot(*example.pose[:2]) == pytest.approx(1.0)
    picture = example.picture
    assert picture.rgb.shape == (64, 64, 3) and (picture.distance > 0).mean() > 0.1 and picture.unknown.mean() < 0.2


def test_a_known_pose_is_the_origin() -> None:
    frame, placed, _ = view_of(1)
    example = accepted(example_of(frame, placed, 32, np.random.default_rng(0), pose_known=True))
    assert np.allclose(example.pose, [1, 0, 0, 0, 0, 0, 0], atol=1e-4)


def test_a_wrong_plane_tilts_and_lifts_the_cube() -> None:
    """The truth is then off by millimetres in z, and the network learns how far planes are."""
    frame, placed, _ = view_of(2)
    lifts = [
        e.pose[6] * e.pose_sigma[4] * e.cube.half_extent
        for i in range(12)
        for e in [accepted(example_of(frame, placed, 16, np.random.default_rng(i), wrong_plane=True))]
    ]
    assert 0.002 < np.std(lifts) < 0.007 and np.abs(lifts).max() < 0.016


def test_without_depth_colour_alone_is_given() -> None:
    """Pixels of the object have no range; place and size along the line of sight are shared out."""
    frame, placed, _ = view_of(3)
    examples = [
        accepted(example_of(replace(frame, depth=None), placed, 32, np.random.default_rng(i))) for i in range(12)
    ]
    assert not any(e.depth for e in examples)
    assert all((e.picture.distance <= 0).all() and (e.picture.distance < 0).any() for e in examples)
    assert np.abs([e.pose[2:5] for e in examples]).mean() < 3.0 and all(e.pose[5] == 0 for e in examples)


def test_something_before_hides_the_share_that_the_picture_says() -> None:
    draws = replace(ALONE, before=1.0, hidden=(0.3, 0.6))
    shares = []
    for seed in range(6):
        view = draw_view(np.random.default_rng(seed), SHAPE, draws=draws)
        (share,) = hidden_share(view.target, view.scene.objects[1:], view.T_world_camera)
        shown, whole = (
            (render_meshes(scene, view.camera, view.T_world_camera).label == 1).sum()
            for scene in (view.scene, MeshScene((view.target,)))
        )
        assert share == pytest.approx(1.0 - shown / whole, abs=0.06)
        shares.append(share)
    assert np.median(shares) > 0.25 and max(shares) < 0.75


def test_borders_cut_the_object() -> None:
    draws = replace(ALONE, border=1.0, cut=(0.3, 0.5))
    for seed in range(4):
        view = draw_view(np.random.default_rng(seed), SHAPE, draws=draws)
        label = render_meshes(view.scene, view.camera, view.T_world_camera).label == 1
        assert label[0].any() or label[-1].any() or label[:, 0].any() or label[:, -1].any()


def test_refusals_are_counted_by_reason() -> None:
    """Every seed gives an example or a reason; the same seeds give the same."""
    huge = MeshShape(SHAPE.vertices, SHAPE.faces, 0.5, (0.5, 0.5, 0.5))
    small = ViewDraws((150.0, 150.0))
    examples, reasons = draw_examples(range(6), [SHAPE, huge], 16, views=small)
    assert len(examples) + reasons.total() == 6 and examples and reasons
    assert all(not any(c.isdigit() for c in reason) for reason in reasons)
    again, _ = draw_examples(range(6), [SHAPE, huge], 16, views=small)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(examples, again, strict=True))
