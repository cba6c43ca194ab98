"""Training pictures show the object that their description tells, where their pose says."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

for library in ("igl", "embreex", "manifold3d"):
    pytest.importorskip(library)

from perception.observation.settings import ObserveConfig  # noqa: E402
from perception.simulation.examples import ExampleDraws  # noqa: E402
from perception.simulation.plain_pictures import PlainDraws  # noqa: E402
from perception.simulation.training_pictures import PicturePart, draw_part, draw_parts, draw_plain_part, picture_set  # noqa: E402
from perception.simulation.view_draws import ViewDraws  # noqa: E402
from probnerf.geometry import pinhole_rays  # noqa: E402
from probnerf.prior.networks import Recognition  # noqa: E402
from probnerf.training.learnt_objects import HOUSEHOLD, TABLETOP, Families  # noqa: E402
from probnerf.training.shape_set import CLIP, DESCRIPTION, GRID  # noqa: E402
from probnerf.types import Pose  # noqa: E402

PLAIN = ExampleDraws(no_depth=0.0, own_mask=0.0, wrong_plane=0.0, pose_known=0.0)
PLAIN_VIEW = PlainDraws(observe=ObserveConfig(range_offset_sigma=1e-6))  # of a small object the bias is large
FREE = ViewDraws(beside=0.0, before=0.0, border=0.0)


@pytest.fixture(scope="module")
def part() -> PicturePart:
    families = Families(tabletop=range(8), tabletop_share=0.5, household=range(8), household_variants=2)
    return draw_part(3, families, 4, 2, 32, PLAIN, FREE)[0]


@pytest.fixture(scope="module")
def plain() -> PicturePart:
    families = Families(tabletop=range(8), tabletop_share=0.5, household=range(8), household_variants=2)
    return draw_plain_part(3, families, 4, 3, 32, PLAIN_VIEW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["part", "plain"])
def test_what_is_seen_lies_on_the_described_surface(kind: str, request: pytest.FixtureRequest) -> None:
    part: PicturePart = request.getfixturevalue(kind)
    assert set(part.family) == {TABLETOP, HOUSEHOLD} and part.description.shape == (4, DESCRIPTION)
    at, misses = (np.arange(GRID) + 0.5) * (2.0 / GRID) - 1.0, []
    for i, row in enumerate(part.row):
        origin, direction = pinhole_rays(part.T_view_camera[i].astype(float), 16 / part.tan_half_fov[i], 32)
        length = part.distance[i].astype(float).ravel()
        seen = (length > 0) & (part.unknown[i].ravel() == 0)
        x, y, log_scale, z = part.pose[i] * part.pose_sigma[i][[0, 1, 2, 4]]
        pose = Pose(yaw=part.yaw[i], x=x, y=y, log_scale=log_scale, z=z)
        points = np.asarray(pose.to_object(origin[seen] + length[seen, None] * direction[seen]))
        grid = CLIP * part.description[row, : GRID**3].astype(float).reshape(GRID, GRID, GRID)
        distance = RegularGridInterpolator((at,) * 3, grid, bounds_error=False)(points)
        misses.append(np.nanmedian(np.abs(distance)))
    assert np.median(misses) < 0.05  # half a cell of the grid
    assert np.max(misses) < 0.15  # a sensor's bias, of a small object


@pytest.mark.slow
def test_plain_pictures_have_errors_of_perceptions_widths(plain: PicturePart) -> None:
    assert len(plain.rgb) == 12 and (plain.distance > 0).any(axis=(1, 2)).all()
    assert (plain.pose_sigma[:, 0] >= 0.08 - 1e-6).all() and np.abs(plain.pose).max() < 5.0
    again = draw_plain_part(3, Families(range(8), 0.5, range(8), 2), 4, 3, 32, PLAIN_VIEW)
    np.testing.assert_array_equal(again.distance, plain.distance)


@pytest.mark.slow
def test_a_part_survives_its_file(part: PicturePart, tmp_path: Path) -> None:
    part.save(tmp_path / "a.npz")
    again = PicturePart.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.distance, part.distance)
    np.testing.assert_array_equal(again.description, part.description)


@pytest.mark.slow
def test_parts_are_drawn_once_and_become_a_set_with_recognised_latents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)  # dask's processes, of other tests, leave it set
    families = Families(tabletop=range(8), tabletop_share=0.0, household=range(8), household_variants=1)

    def drawn(numbers: range) -> dict[Path, int]:
        return {
            path: path.stat().st_mtime_ns for path in draw_parts(tmp_path, numbers, families, 16, 2, objects=2, views=1)
        }

    first = drawn(range(1))
    both = drawn(range(2))
    assert first.items() <= both.items() and len(both) == 2
    assert "JAX_PLATFORMS" in os.environ and "OMP_NUM_THREADS" not in os.environ
    parts = [PicturePart.load(path) for path in sorted(both)]
    recognition = Recognition(DESCRIPTION, 3, 8, jax.random.key(0))
    pictures = picture_set(parts, recognition)
    assert len(pictures) == sum(len(part.rgb) for part in parts)
    mean, precision = recognition(jnp.asarray(parts[1].description[parts[1].row[-1]], jnp.float32))
    np.testing.assert_allclose(pictures.mean[-1], mean, atol=1e-5)
    np.testing.assert_allclose(pictures.sd[-1], precision**-0.5, rtol=1e-5)
    assert pictures.kind[-1] == parts[1].kind[parts[1].row[-1]]
