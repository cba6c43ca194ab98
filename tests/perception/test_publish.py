"""Of which voxels of a cube shapes are asked."""

import numpy as np

from perception.observe import observe
from perception.seen import answered_voxels, seen_voxels
from perception.segment import segment
from probnerf.occupancy import voxel_centres
from tests.perception.cylinders import CAN, looking_down, picture


def test_all_is_asked_but_space_seen_free_well_before_the_surface() -> None:
    T = looking_down(35.0)
    frame = picture(CAN, T=T)
    (found,) = segment(frame)
    cube = observe(frame, found)[1]
    asked, seen = answered_voxels(frame, found, cube, 64), seen_voxels(frame, found, cube, 64)
    assert asked[~seen].all() and not asked.all()
    points = (cube.to_camera(voxel_centres(64).astype(np.float64)) @ T[:3, :3].T) + T[:3, 3]
    beside = np.hypot(points[..., 0] - CAN.x, points[..., 1] - CAN.y) - CAN.radius
    above = points[..., 2] - CAN.height
    voxel = 2 * cube.half_extent / 64
    body = (np.maximum(beside, above) <= 0.0) & (points[..., 2] > 0)
    assert (body & seen).any() and asked[body].all()  # also where its wall is seen
    over = (above > 4 * voxel) & seen  # the camera looks down on the top
    assert over.any() and not asked[over].all()
    assert (~asked).mean() > 0.15
