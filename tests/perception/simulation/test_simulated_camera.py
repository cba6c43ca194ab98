"""The simulated sensor: its truth is the family's, its faults have the stated sizes; and the shipped recording."""

import numpy as np
import pytest

from calibration.camera import Camera
from perception.observation.segmentation import backproject, segment
from perception.simulation import sample_recording
from perception.simulation.sensor_faults import SensorConfig, sense, simulate
from perception.simulation.simulated_camera import FaultlessImage, PlacedObject, TableScene, place_camera, render, truth
from perception.sources.frame import Frame
from perception.sources.open_source import open_source
from perception.sources.settings import SHIPPED_LOG
from probnerf.objects.tabletop import part_distances, signed_distance

CAMERA = Camera(160, 120, np.array([[150.0, 0, 80.3], [0, 151.0, 59.1], [0, 0, 1]]), np.array([0.05, -0.1, 0, 0, 0.0]))
T_WORLD_CAMERA = place_camera((0.4, 0.1, 0.3), (0.0, 0.0, 0.03))
SCENE = TableScene((PlacedObject(2_900_727, -0.03, -0.05, 2.0), PlacedObject(2_900_483, 0.0, 0.08, 0.3)))


@pytest.fixture(scope="module")
def picture() -> FaultlessImage:
    return render(SCENE, CAMERA, T_WORLD_CAMERA)


@pytest.fixture(scope="module")
def shipped_frames() -> list[Frame]:
    return list(open_source(None))


@pytest.fixture(scope="module")
def shipped_picture() -> FaultlessImage:
    return render(sample_recording.SCENE, sample_recording.CAMERA, sample_recording.T_WORLD_CAMERA)


def in_cube(frame: Frame, pixels: np.ndarray, placed: PlacedObject, T_camera_object: np.ndarray) -> np.ndarray:
    """The points that pixels see, in an object's canonical cube."""
    points = backproject(frame)[pixels]
    return (points - T_camera_object[:3, 3]) @ T_camera_object[:3, :3] / placed.half_extent


def test_depth_lies_on_the_true_surfaces(picture: FaultlessImage) -> None:
    """Through a lens with distortion, and through `truth`."""
    assert set(np.unique(picture.label)) == {0, 1, 2}
    frame = Frame(np.zeros((120, 160, 3), np.uint8), picture.depth.astype(np.float32), CAMERA, frame_id="")
    for i, (placed, T) in enumerate(zip(SCENE.objects, truth(SCENE, T_WORLD_CAMERA), strict=True), start=1):
        cube = in_cube(frame, picture.label == i, placed, T)
        assert np.abs(np.asarray(signed_distance(placed.shape, cube.astype(np.float32)))).max() < 3e-3
    world = backproject(frame)[picture.label == 0] @ T_WORLD_CAMERA[:3, :3].T + T_WORLD_CAMERA[:3, 3]
    on_table = np.abs(world[:, 2]) < 1e-5
    on_wall = np.abs(world[:, 0] + 1.6) < 1e-5
    assert on_table.mean() > 0.5 and (on_table | on_wall).all()


def test_noise_has_the_stated_size() -> None:
    """On a plane that faces the camera: 1 mm + 2 mm/m^2 z^2, and the quantum's own 1/12."""
    camera = Camera(200, 200, np.array([[200.0, 0, 100], [0, 200.0, 100], [0, 0, 1]]), np.zeros(5))
    for z in (0.4, 1.2):
        flat = np.full((200, 200), z + 0.0003)
        plane = FaultlessImage(np.zeros((200, 200, 3)), flat, flat, flat, np.zeros((200, 200), np.int32))
        depth = sense(plane, camera, None, seed=3).depth
        sigma = np.hypot(0.001 + 0.002 * z**2, 0.001 / np.sqrt(12))
        error = (depth - flat)[np.isfinite(depth)]
        assert error.std() == pytest.approx(sigma, rel=0.03) and abs(error.mean()) < 0.05 * sigma
        assert 0.98 < np.isfinite(depth).mean() < 1.0  # blobs
        assert np.allclose(depth[np.isfinite(depth)] * 1000, np.rint(depth[np.isfinite(depth)] * 1000), atol=1e-3)


def test_blobs_may_reach_over_every_border() -> None:
    """A blob may be wider than the picture, and may have its middle at any edge."""
    camera = Camera(24, 12, np.array([[20.0, 0, 12], [0, 20.0, 6], [0, 0, 1]]), np.zeros(5))
    flat = np.full((12, 24), 0.5)
    plane = FaultlessImage(np.zeros((12, 24, 3)), flat, flat, flat, np.zeros((12, 24), np.int32))
    many = SensorConfig(blobs=0.1, blob_radius=8.0)
    lost = [np.isnan(sense(plane, camera, None, seed=s, config=many).depth).mean() for s in range(20)]
    assert min(lost) > 0.5


def test_depth_fails_at_edges_and_in_the_stereo_shadow(picture: FaultlessImage) -> None:
    frame = sense(picture, CAMERA, T_WORLD_CAMERA, seed=1)
    lost = np.isnan(frame.depth)
    mixed = picture.farthest - picture.nearest > 0.05
    assert 0.6 < lost[mixed].mean() < 0.9
    between = mixed & ~lost
    inside = (frame.depth > picture.nearest - 0.02) & (frame.depth < picture.farthest + 0.02)
    assert between.sum() > 10 and inside[between].all()  # flying pixels
    objects = picture.label > 0
    left = np.zeros_like(objects)
    left[:, :-3] = objects[:, 3:] & ~objects[:, :-3]
    right = np.zeros_like(objects)
    right[:, 3:] = objects[:, :-3] & ~objects[:, 3:]
    calm = ~mixed & ~objects & (picture.depth < 0.8)
    assert lost[left & calm].mean() > 0.2 > 0.06 > lost[right & calm].mean()
    assert lost[calm & ~left & ~right].mean() < 0.03


def test_grazing_surfaces_have_no_depth() -> None:
    table = TableScene(())
    T = place_camera((0.4, 0.0, 0.04), (-0.4, 0.0, 0.0))
    lost = np.isnan(simulate(table, CAMERA, T, 0, SensorConfig(blobs=0.0, flying=0.0)).depth)
    below = np.degrees(np.arctan((np.arange(120) - CAMERA.K[1, 2]) / CAMERA.K[1, 1]) + np.arctan(0.04 / 0.8))
    assert lost[(below > 3.0) & (below < 5.0)].mean() > 0.95 and lost[below > 11.0].mean() < 0.01


def test_frames_are_functions_of_the_seed() -> None:
    first, again, other = (simulate(SCENE, CAMERA, T_WORLD_CAMERA, seed) for seed in (1, 1, 2))
    assert np.array_equal(first.depth, again.depth, equal_nan=True) and np.array_equal(first.rgb, again.rgb)
    assert not np.array_equal(first.depth, other.depth, equal_nan=True)
    assert np.array_equal(first.label, other.label)


def test_shipped_recording_is_what_its_script_makes(
    shipped_frames: list[Frame], shipped_picture: FaultlessImage
) -> None:
    assert SHIPPED_LOG.stat().st_size < 2_000_000
    assert [f.stamp_ns for f in shipped_frames] == [
        sample_recording.START_NS + i * sample_recording.STEP_NS for i in range(5)
    ]
    made = sense(shipped_picture, sample_recording.CAMERA, None, seed=0, config=sample_recording.SENSOR)
    first = shipped_frames[0]
    assert first.label is None and first.camera.K.tolist() == made.camera.K.tolist()
    both = np.isfinite(first.depth) & np.isfinite(made.depth)
    assert (np.isfinite(first.depth) == np.isfinite(made.depth)).mean() > 0.999
    assert np.median(np.abs(first.depth - made.depth)[both]) < 1e-4
    assert np.median(np.abs(first.rgb.astype(int) - made.rgb)) <= 1


def test_shipped_mug_is_found_and_its_handle_is_hidden(
    shipped_frames: list[Frame], shipped_picture: FaultlessImage
) -> None:
    mug, carton = segment(shipped_frames[0])
    for found, i in ((mug, 1), (carton, 2)):
        true = shipped_picture.label == i
        assert (found.mask & true).sum() > 0.9 * true.sum() and (found.mask & ~true).sum() < 0.01 * true.sum()
    assert mug.occluder.any()
    assert bool(sample_recording.MUG.shape.has_handle)
    T = truth(sample_recording.SCENE, sample_recording.T_WORLD_CAMERA)[0]
    clean = Frame(shipped_frames[0].rgb, shipped_picture.depth.astype(np.float32), sample_recording.CAMERA, frame_id="")
    cube = in_cube(clean, shipped_picture.label == 1, sample_recording.MUG, T).astype(np.float32)
    body, handle = map(np.asarray, part_distances(sample_recording.MUG.shape, cube))
    assert (handle < body).mean() < 0.001  # no pixel sees it
    assert (shipped_picture.label == 2).any() and (shipped_picture.label == 1)[250:, 300:].any()
