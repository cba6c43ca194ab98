"""Laws of shapes sampled from meshes: labels are the solid's, splits are by class, and a set survives its file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("igl")
pytest.importorskip("manifold3d")

from probnerf.objects.shape_kinds import kind_of_name
from probnerf.training.mesh_shapes import (
    PAINTS,
    folder_shapes,
    held_out,
    household_shapes,
    placed,
    sample_mesh,
    variant,
)
from probnerf.training.shape_set import CLIP, GRID, ShapeSet, centres, draw_shapes, in_cube, load_shapes
from probnerf.types import KINDS


@pytest.fixture(scope="module")
def household() -> ShapeSet:
    return household_shapes(range(6), 2)


def test_labels_and_distances_are_the_solids() -> None:
    thing, seed = variant(trimesh.creation.box((0.1, 0.08, 0.06)), "box", "box", 3)
    thing = placed(thing, np.random.default_rng(0))
    shapes = sample_mesh(thing, seed)
    exact = thing.signed_distance(in_cube(shapes.points[0]))
    sure = np.abs(exact) > 1e-4
    assert np.array_equal(shapes.inside[0][sure], (exact <= 0.0)[sure])
    grid = np.clip(thing.signed_distance(centres(GRID)), -CLIP, CLIP)
    np.testing.assert_allclose(shapes.distance[0].astype(float), grid, atol=2e-4)
    assert np.abs(thing.signed_distance(in_cube(shapes.surface[0]))).max() < 1e-4


def test_a_set_depends_on_its_seeds_alone_and_survives_its_file(household: ShapeSet, tmp_path: Path) -> None:
    again = household_shapes(range(3, 4), 2)
    np.testing.assert_array_equal(again.points, household.points[6:8])
    np.testing.assert_array_equal(again.rgb, household.rgb[6:8])
    household.save(tmp_path / "a.npz")
    loaded = load_shapes(tmp_path / "a.npz")
    assert len(loaded) == 12
    np.testing.assert_array_equal(loaded.inside, household.inside)
    np.savez(tmp_path / "b.npz", kind=np.zeros(3))
    with pytest.raises(ValueError, match="lacks distance"):
        load_shapes(tmp_path / "b.npz")


def test_batches_mix_sets_by_their_shares(household: ShapeSet) -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_shapes([(household[:4], 0.25), (household[4:], 0.75)], rng, 8, 40, 20) for _ in range(50)]
    assert drawn[0].points.shape == (8, 40, 3) and drawn[0].rgb.shape == (8, 20, 3)
    first = household.distance[:4].astype(np.float32) / CLIP
    hits = np.mean([(b.distance[:, None] == first[None]).all(-1).any(1).mean() for b in drawn])
    assert 0.15 < hits < 0.35
    assert household.rgb.shape[1] == PAINTS
    assert np.asarray(drawn[0].description).shape[0] == 8


def test_classes_are_held_out_whole_and_reasons_are_told(tmp_path: Path) -> None:
    names = [f"thing{chr(97 + i)}_{k}" for i in range(26) for k in (1, 2)]
    kept = [name for name in names if not held_out(name)]
    assert 0 < len(names) - len(kept) < 12
    assert all(held_out(f"thing{chr(97 + i)}_1") == held_out(f"thing{chr(97 + i)}_2") for i in range(26))
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / f"{kept[0]}.ply")
    trimesh.creation.box((9.0, 9.0, 9.0)).export(tmp_path / "huge.ply")
    shapes, left_out = folder_shapes(tmp_path, 3)
    assert len(shapes) == 3 and len(left_out) == 1 and "huge: longest side" in left_out[0]
    (tmp_path / f"{kept[0]}.ply").unlink()
    with pytest.raises(ValueError, match="none of its 1 meshes"):
        folder_shapes(tmp_path, 3)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("plastic_bottle_01", "vessel"), ("FoodBox_7", "box"), ("wooden_mallet", "other"), ("candle", "other")],
)
def test_a_name_tells_the_kind_by_whole_words(name: str, kind: str) -> None:
    assert kind_of_name(name) == kind
    assert kind in KINDS
