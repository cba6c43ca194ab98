"""The household family: closed meshes of true size, the same for the same seed, of every kind in its share."""

import numpy as np
import pytest

from probnerf.objects.household import FAMILIES, LARGEST_M, MAX_FACES, SMALLEST_M, HouseholdObject, draw_mesh, mesh_of
from probnerf.objects.household_parts import arc, bent, lathe, plate, rectangle, smooth, superquadric, tube, vessel
from probnerf.objects.household_vessels import mug


@pytest.fixture(scope="module")
def objects() -> list[HouseholdObject]:
    return [draw_mesh(seed) for seed in range(40)]


def assert_closed_and_of_true_size(mesh) -> None:
    assert np.isfinite(mesh.vertices).all()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0.0  # normals point outwards
    assert len(mesh.faces) <= MAX_FACES
    assert SMALLEST_M - 1e-9 <= mesh.extents.max() <= LARGEST_M + 1e-9
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-9)


def test_a_seed_always_gives_the_same_mesh() -> None:
    for seed in (0, 5, 18, 1_000_003):
        first, second = draw_mesh(seed), draw_mesh(seed)
        assert (first.kind, first.name, first.any_pose) == (second.kind, second.name, second.any_pose)
        assert np.array_equal(first.mesh.vertices, second.mesh.vertices)
        assert np.array_equal(first.mesh.faces, second.mesh.faces)
    assert not np.array_equal(draw_mesh(0).mesh.bounds, draw_mesh(1).mesh.bounds)


def test_meshes_are_closed_of_true_size_and_stand_on_the_plane(objects: list[HouseholdObject]) -> None:
    for obj in objects:
        assert_closed_and_of_true_size(obj.mesh)
        if obj.kind != "vessel":
            assert obj.mesh.bounds[:, :2].mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert {obj.kind for obj in objects} == {"vessel", "box", "other"}


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_every_family_is_one_closed_body(family) -> None:
    for seed in range(3):
        solid = family.draw(np.random.default_rng(seed))
        assert_closed_and_of_true_size(mesh_of(solid, centred=True))
        volumes = np.abs([body.volume() for body in solid.decompose()])
        assert volumes.max() > 0.999 * volumes.sum()  # nothing floats, no cavity is shut


def test_kinds_have_their_shares() -> None:
    total = sum(family.weight for family in FAMILIES)
    shares = {k: sum(f.weight for f in FAMILIES if f.kind == k) / total for k in ("vessel", "box", "other")}
    assert shares == pytest.approx({"vessel": 0.4, "box": 0.2, "other": 0.4}, abs=0.03)
    assert len({family.name for family in FAMILIES}) == len(FAMILIES)


def test_mugs_have_a_hole_for_each_handle() -> None:
    genera = [mug(np.random.default_rng(seed)).genus() for seed in range(30)]
    assert set(genera) <= {0, 1, 2}
    assert 0.6 < np.mean(np.asarray(genera) == 1) < 0.95


def test_a_vessel_holds_what_its_walls_leave() -> None:
    outline = smooth([(0.04, 0.0), (0.04, 0.1)])
    hollow = lathe(outline).volume() - vessel(outline, 0.003, 0.005).volume()
    assert hollow == pytest.approx(np.pi * 0.037**2 * 0.095, rel=0.01)


def test_parts_have_the_volumes_of_their_formulas() -> None:
    section = np.pi * 0.004 * 0.006
    half_ring = tube(arc((0.0, 0.0), (0.05, 0.05), 0.0, 180.0, 60), 0.004, 0.006)
    assert half_ring.volume() == pytest.approx(np.pi * 0.05 * section, rel=0.03)
    assert superquadric((0.01, 0.02, 0.03)).volume() == pytest.approx(4.0 / 3.0 * np.pi * 6e-6, rel=0.02)
    box = superquadric((0.01, 0.02, 0.03), 0.1, 0.1).volume()
    assert 0.9 * 4.8e-5 < box < 4.8e-5
    bar = plate(rectangle((-0.05, -0.01), (0.05, 0.01)), 0.004)
    assert bent(bar, 8.0, 0.004).volume() == pytest.approx(bar.volume(), rel=0.01)
    assert bent(bar, 8.0, 0.004).bounding_box()[5] > 0.01  # its ends rise
