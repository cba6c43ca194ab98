"""Solid space: what is closed is solid, what is open is not, and a pinhole does not decide it."""

import numpy as np
import pytest

from probnerf.rendering.occupancy import (
    above_plane,
    coarsen,
    solid,
    voxel_centres,
    voxel_index,
    voxel_surface,
)
from probnerf.types import BASE_Z

GRID = 32
WIDTH = 2.0 / GRID


def _can(grid: int = GRID, lid: bool = True, bottom: bool = True) -> np.ndarray:
    """A hollow cylinder of radius 0.5 from BASE_Z to 0.25, walls two voxels thick."""
    x, y, z = np.moveaxis(voxel_centres(grid), -1, 0)
    radius, wall = np.hypot(x, y), 4.0 / grid
    body = (radius < 0.5) & (z > BASE_Z) & (z < 0.25)
    cavity = radius < 0.5 - wall
    cavity &= z > BASE_Z + wall if bottom else z > -1.0
    cavity &= z < 0.25 - wall if lid else z < 1.0
    return body & ~cavity


def test_a_closed_can_is_solid_and_an_open_cup_is_not():
    x, y, z = np.moveaxis(voxel_centres(GRID), -1, 0)
    whole = (np.hypot(x, y) < 0.5) & (z > BASE_Z) & (z < 0.25)
    np.testing.assert_array_equal(solid(_can().astype(np.float32)), whole)
    cup = _can(lid=False)
    # Closing may round the inner edge of the cup's bottom, never its outline or its cavity's core.
    filled = solid(cup.astype(np.float32))
    assert not filled[(np.hypot(x, y) < 0.3) & (z > BASE_Z + 2.1 * WIDTH)].any()
    assert filled[cup].all() and not filled[~whole].any()


def test_a_pinhole_is_closed_and_a_hole_is_not():
    centre = GRID // 2
    for width, expected in ((1, True), (2, True), (3, False)):
        leaky = _can()
        leaky[centre : centre + width, centre : centre + width, centre:] = False
        assert solid(leaky.astype(np.float32))[centre, centre, centre - 4] == expected


def test_walls_survive_and_narrow_gaps_between_them_close():
    walls = np.zeros((GRID,) * 3, bool)
    for x in (8, 10, 16, 21):  # gaps of 1, 5 and 4 voxels
        walls[x, 8:24, 8:24] = True
    filled = solid(walls.astype(np.float32))
    assert filled[walls].all() and filled[9, 9:23, 9:23].all()
    assert not filled[11:16].any() and not filled[17:21].any()


def test_the_plane_is_no_wall_but_nothing_below_it_is_occupied():
    bottomless = solid(_can(bottom=False).astype(np.float32))
    assert not bottomless[GRID // 2, GRID // 2, GRID // 4]
    sunk = np.roll(_can(), -2, axis=2)  # its bottom lies wholly below the plane, and still seals it
    filled = solid(sunk.astype(np.float32))
    assert filled[GRID // 2, GRID // 2, GRID // 4]
    assert not filled[voxel_centres(GRID)[..., 2] < BASE_Z].any()


def test_each_shape_ends_at_the_height_that_it_stands_on_and_what_it_stands_on_is_solid():
    z, base = voxel_centres(GRID)[0, 0, :, 2], np.array([BASE_Z - 2.1 * WIDTH, BASE_Z, BASE_Z + 2.1 * WIDTH])
    every = solid(np.ones((3, *(GRID,) * 3)), base)
    np.testing.assert_array_equal(every[:, 5, 5], z >= np.minimum(base, BASE_Z)[:, None])
    # the table, which is higher than measured there, has the outline that stands on it, whatever was drawn in it
    cone = np.hypot(*np.moveaxis(voxel_centres(GRID)[..., :2], -1, 0)) < 0.3 + 0.4 * (z - BASE_Z)
    stood = solid(cone.astype(np.float32), base[2])
    lowest = int(np.flatnonzero(z >= base[2])[0])
    for k in np.flatnonzero((z >= BASE_Z) & (z < base[2])):
        np.testing.assert_array_equal(stood[..., k], stood[..., lowest])
    np.testing.assert_array_equal(stood[..., lowest:], solid(cone.astype(np.float32))[..., lowest:])
    assert cone[..., k].sum() < stood[..., k].sum() and not stood[..., z < BASE_Z].any()


def test_the_border_of_the_cube_is_empty_space():
    slab = np.zeros((GRID,) * 3, np.float32)
    slab[:, :, GRID // 2] = 1.0  # cuts the cube in two; both halves are open at the cube's sides
    np.testing.assert_array_equal(solid(slab), slab > 0)
    np.testing.assert_array_equal(solid(np.ones((GRID,) * 3))[..., GRID // 8 :], True)
    assert not solid(np.zeros((GRID,) * 3)).any()


def test_bytes_floats_and_batches_agree():
    opacity = np.random.default_rng(0).uniform(size=(2, 3, 16, 16, 16)).astype(np.float32)
    opacity[..., :8] *= 0.6
    expected = np.stack([[solid(one) for one in row] for row in opacity])
    np.testing.assert_array_equal(solid(opacity), expected)
    np.testing.assert_array_equal(solid(np.rint(255 * opacity).astype(np.uint8)), solid(np.rint(255 * opacity) / 255))
    with pytest.raises(ValueError, match="last three axes"):
        solid(np.zeros((4, 4, 5)))


def test_voxels_hold_their_centres_and_the_cube_its_faces():
    centres = voxel_centres(GRID)
    np.testing.assert_array_equal(voxel_index(centres, GRID).ravel(), np.arange(GRID**3))
    np.testing.assert_array_equal(voxel_index([[1, 1, 1], [-1, -1, -1], [1.001, 0, 0]], GRID), [GRID**3 - 1, 0, -1])


def test_the_surface_of_a_box_has_its_area_and_lies_on_its_faces():
    box = np.zeros((GRID,) * 3, bool)
    box[0:4, 8:16, 16:18] = True  # touches the cube's border
    surface = voxel_surface(box)
    assert len(surface) == 2 * (4 * 8 + 4 * 2 + 8 * 2)
    np.testing.assert_allclose(surface.min(0), [-1, -0.5, 0])
    np.testing.assert_allclose(surface.max(0), [-0.75, 0, 2 * WIDTH])


def test_a_coarse_voxel_is_occupied_where_any_fine_one_is():
    fine = np.random.default_rng(1).uniform(size=(2, 8, 8, 8)) < 0.1
    coarse = coarsen(fine, 4)
    assert coarse[1, 2, 3, 0] == fine[1, 4:6, 6:8, 0:2].any()
    assert coarse.shape == (2, 4, 4, 4) and coarse.mean() > fine.mean()
    with pytest.raises(ValueError, match="divide"):
        coarsen(fine, 3)


@pytest.mark.parametrize("grid", [4, 8, 12, 16, 20, 32, 64, 128])
def test_above_the_plane_is_where_a_shape_that_fills_the_cube_is_solid(grid):
    full = solid(np.ones((grid, grid, grid), np.float32))
    np.testing.assert_array_equal(full, np.broadcast_to(above_plane(grid), full.shape))
    z = voxel_centres(grid)[0, 0, :, 2]
    np.testing.assert_array_equal(above_plane(grid), z >= BASE_Z)
    # Only where grid / 4 is odd does a level of centres lie in the plane; it counts as above.
    assert (z == BASE_Z).any() == (grid % 8 == 4)
