"""What was seen: all before the measured end of a ray, and the voxel in which it ends, and nothing behind."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from calibration.camera import Camera
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import Segment
from perception.observation.visibility import answered_voxels, inside_view, seen_voxels
from perception.sources.frame import Frame
from probnerf.rendering.occupancy import voxel_centres
from tests.properties.drawn import every_field, poses, seeds, slower_law, vectors

GRID = 16
CAMERA = Camera(48, 36, np.array([[50.0, 0.0, 23.5], [0.0, 50.0, 17.5], [0.0, 0.0, 1.0]]), np.zeros(5))


@st.composite
def pictures(draw: st.DrawFn) -> tuple[Frame, Segment, ObjectFrame]:
    """A frame with any depth, some missing, and a cube in or about the picture."""
    T = draw(poses())
    T[:3, 3] = [0.03, 0.03, 0.05] * T[:3, 3] + [0.0, 0.0, 0.6]
    cube = draw(
        every_field(ObjectFrame, T_camera_object=st.just(T), half_extent=st.floats(0.05, 0.15), plane=vectors(4))
    )
    rng = np.random.default_rng(draw(seeds))
    size = (CAMERA.height, CAMERA.width)
    depth = rng.uniform(0.3, 0.9, size)
    depth[rng.random(size) < 0.1] = np.nan
    frame = Frame(np.zeros((*size, 3), np.uint8), depth.astype(np.float32), CAMERA)
    mask = np.zeros(size, bool)
    return frame, Segment(1, mask, cube.plane, mask.astype(np.int32), mask), cube


def deeper(frame: Frame, by: float, known: np.ndarray | None = None) -> Frame:
    """The frame with all ends farther by so much (m), and where `known` is given, known there alone."""
    assert frame.depth is not None
    depth = frame.depth + np.float32(by)
    return replace(frame, depth=depth if known is None else np.where(known, depth, np.float32(np.nan)))


@slower_law
@given(pictures())
def test_a_voxel_is_seen_if_its_sphere_reaches_the_end_of_its_ray(drawn: tuple[Frame, Segment, ObjectFrame]) -> None:
    """The sphere about the centre through the corners: a surface inside the voxel is surely in it."""
    frame, found, cube = drawn
    assert frame.depth is not None
    cubes = voxel_centres(GRID).reshape(-1, 3)
    centre, corner = cube.to_camera(cubes), cube.to_camera(cubes + 1.0 / GRID)
    pixel = CAMERA.project(centre)
    u, v = np.clip(np.round(pixel), 0, [CAMERA.width - 1, CAMERA.height - 1]).astype(int).T
    end = centre * (frame.depth[v, u] / centre[:, 2])[:, None]
    before = np.linalg.norm(end, axis=1) >= np.linalg.norm(centre, axis=1)
    beyond = np.linalg.norm(centre - end, axis=1) / np.linalg.norm(corner - centre, axis=1)
    expected = (before | (beyond <= 1.0)) & inside_view(CAMERA, cube, GRID).ravel()
    seen = seen_voxels(frame, found, cube, GRID).ravel()
    near = np.abs(np.linalg.norm(end, axis=1) - np.linalg.norm(centre, axis=1)) < 1e-6
    between = (np.abs(pixel - np.floor(pixel) - 0.5) < 1e-4).any(axis=1)  # two pixels
    decided = ~((np.abs(beyond - 1.0) < 1e-5) | near | between)  # but for rounding
    np.testing.assert_array_equal(seen[decided], expected[decided])


@slower_law
@given(pictures(), st.floats(0.0, 0.5), seeds)
def test_who_looks_farther_sees_more_and_who_knows_less_sees_less(
    drawn: tuple[Frame, Segment, ObjectFrame], by: float, seed: int
) -> None:
    frame, found, cube = drawn
    known = np.random.default_rng(seed).random((CAMERA.height, CAMERA.width)) < 0.5
    seen = seen_voxels(frame, found, cube, GRID)
    assert (seen_voxels(deeper(frame, by), found, cube, GRID) | ~seen).all()
    assert not (seen_voxels(deeper(frame, 0.0, known), found, cube, GRID) & ~seen).any()
    # Two halves of a picture saw together what the whole one did.
    halves = [seen_voxels(deeper(frame, 0.0, half), found, cube, GRID) for half in (known, ~known)]
    np.testing.assert_array_equal(halves[0] | halves[1], seen)


@slower_law
@given(pictures())
def test_shapes_are_asked_of_all_that_was_not_seen(drawn: tuple[Frame, Segment, ObjectFrame]) -> None:
    frame, found, cube = drawn
    assert (answered_voxels(frame, found, cube, GRID) | seen_voxels(frame, found, cube, GRID)).all()
