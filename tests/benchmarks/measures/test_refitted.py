"""What a prior is asked to hold: walls of a mesh on a grid, and which of its parts are thin."""

import jax
import numpy as np
import pytest
import trimesh

pytest.importorskip("igl")
pytest.importorskip("manifold3d")

from benchmarks.measures.refitted import GRID, refit, thin_parts, walls
from benchmarks.scenes.held_out import held_out_things
from probnerf.objects.mesh import canonical
from probnerf.prior.networks import PRESETS, ProbNeRF, Recognition
from probnerf.rendering.occupancy import voxel_centres
from probnerf.training.shape_set import DESCRIPTION


def test_walls_are_voxels_that_the_solid_meets() -> None:
    box = trimesh.creation.box((0.2, 0.1, 0.08))
    thing = canonical(box.vertices, box.faces)
    found = walls(thing)
    distance = thing.signed_distance(voxel_centres(GRID).reshape(-1, 3).astype(float)).reshape(found.shape)
    assert found[distance <= 0.0].all()
    assert not found[distance > np.sqrt(3.0) / GRID + 1e-6].any()


def test_a_shaft_is_thin_and_a_head_is_not() -> None:
    head = trimesh.creation.box((0.06, 0.06, 0.05))
    shaft = trimesh.creation.box((0.16, 0.006, 0.006))
    shaft.apply_translation([0.1, 0.0, 0.0])
    vertices = np.concatenate([head.vertices, shaft.vertices])
    thing = canonical(vertices, np.concatenate([head.faces, shaft.faces + len(head.vertices)]))
    thin = thin_parts(walls(thing), thing.half_extent)
    x = voxel_centres(GRID)[..., 0]
    middle = 0.25  # cube units: beyond it there is only the shaft
    assert thin[walls(thing) & (x > middle)].mean() > 0.95
    assert thin[walls(thing) & (x < -0.3)].mean() < 0.05


def test_held_out_things_are_the_generators_validation_seeds() -> None:
    things = list(held_out_things(2, {}))
    assert [source for source, *_ in things] == ["generator", "generator"]
    assert all(name.endswith(("_1000000", "_1000001")) for _, thing, _ in things for name in (thing.name,))


@pytest.mark.slow
def test_a_fit_begins_where_recognition_tells() -> None:
    """An untrained recognition tells another start, so another fit; both are judged by the same true solid."""
    box = trimesh.creation.box((0.2, 0.1, 0.08))
    thing = canonical(box.vertices, box.faces)
    model = jax.jit(lambda key: ProbNeRF(PRESETS["tiny"], key))(jax.random.key(0))
    told = Recognition(DESCRIPTION, model.latent, 8, jax.random.key(1))
    plain, begun = (refit(model, "", thing, 0, recognition) for recognition in (None, told))
    assert np.array_equal(plain.true_solid, begun.true_solid) and 0.0 <= plain.iou <= 1.0
    assert not np.array_equal(plain.solid, begun.solid)
