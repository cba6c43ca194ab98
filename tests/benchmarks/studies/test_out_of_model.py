"""Strangers: a mesh on the table is seen and filled as it is, and a check's power is what it says."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.harness.results import Results
from benchmarks.scenes.meshes import enclosed, mesh_view
from benchmarks.scenes.vessels import ViewConfig
from benchmarks.studies.out_of_model import CONDITIONS, FAMILY, Options, detection, main
from probnerf.prior.checkpoint import load_prior


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("meshes") / "box.obj"
    trimesh.creation.box((0.4, 0.6, 1.0)).export(path)
    return path


def test_a_box_is_seen_where_it_stands_and_is_solid_within(box: Path) -> None:
    view = mesh_view(box, 3, ViewConfig(width=320, height=240, focal=300.0))
    z = (view.frame.label == 1) & np.isfinite(view.frame.depth)
    assert z.sum() > 500
    measured = view.frame.camera.rays(np.column_stack(np.nonzero(z)[::-1]))
    points = view.cube.to_cube(measured / measured[:, 2:] * view.frame.depth[z][:, None])
    voxels = np.clip(np.floor((points + 1.0) * 16).astype(int), 0, 31)
    near = np.pad(view.solid, 1)
    near = np.any([np.roll(near, s, a) for a in range(3) for s in (-1, 0, 1)], axis=0)[1:-1, 1:-1, 1:-1]
    assert near[tuple(voxels.T)].mean() > 0.97  # what was measured lies on the solid
    sides = np.ptp(np.argwhere(view.solid), axis=0) / 16 * view.cube.half_extent
    assert sides[2] == pytest.approx(2.0 * np.hypot(*sides[:2]) / np.hypot(0.8, 1.2), rel=0.6)
    volume = view.solid.sum() * (view.cube.half_extent / 16) ** 3
    assert 0.9 < volume / (0.24 * sides[2] ** 3) < 1.5  # voxels that it touches count whole
    assert (view.seen & view.solid).sum() < 0.5 * view.solid.sum() < view.solid.sum()


def test_a_hollow_that_is_open_stays_empty() -> None:
    up = np.linspace(-0.5, 0.5, 400)
    angle, height = (a.ravel() for a in np.meshgrid(np.linspace(0, 2 * np.pi, 1000), up))
    wall = np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height])
    r = np.sqrt(np.random.default_rng(0).random(200_000)) * 0.5
    turn = np.random.default_rng(1).random(200_000) * 2 * np.pi
    disc = np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(len(r), -0.5)])
    cup, can = np.concatenate([wall, disc]), np.concatenate([wall, disc, disc * [1, 1, -1]])
    assert not enclosed(cup, 32)[16, 16, 16] and enclosed(can, 32)[16, 16, 16]


def test_a_file_without_triangles_is_named(tmp_path: Path) -> None:
    path = tmp_path / "points.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\n")
    with pytest.raises(ValueError, match=r"points\.obj holds no triangles"):
        mesh_view(path, 0)


def test_detection_at_five_percent_and_area() -> None:
    family = np.arange(100.0)
    assert detection(family, np.full(7, -1.0)) == (1.0, 1.0)
    found, area = detection(family, np.array([4.0, 4.5, 50.0, 200.0]))
    assert found == 0.5 and area == pytest.approx((0.955 + 0.95 + 0.495 + 0.0) / 4)


def test_answers_that_are_there_are_not_made_again(box: Path, tmp_path: Path) -> None:
    kept = Results(tmp_path / "kept.jsonl")
    with pytest.raises(ValueError, match="no mesh"):
        main(Options(tmp_path, n=1, meshes=tmp_path, results=kept.path))
    same = {"prior": load_prior().identity, "method": "tempered_smc", "settings": {}, "seed": 0}
    for condition in CONDITIONS:
        for number, fit in enumerate((0.9, 0.95) if condition == FAMILY else (0.5, 0.93)):
            told = {"explained": fit, "evidence": fit, "flagged": fit < 0.8, "hidden_nll_queried": 0.2}
            boxes = {"p_free_alone": [1.0, 0.9], "p_free_queried": [0.96, 0.5], "occupied": [0, 1]}
            kept.add({**same, "condition": condition, "object": number, **told, **boxes})
    kept.add({**same, "condition": CONDITIONS[1], "object": "flat", "refused": "too small"})
    summary = main(Options(tmp_path, results=kept.path, only_chart=True))
    rows = {(r.condition, r.metric): r.value for r in summary.rows}
    assert summary.picture().axes
    assert rows[CONDITIONS[1], "detected_at_5_explained"] == 0.5 and rows[FAMILY, "flagged"] == 0.0
    assert rows[CONDITIONS[1], "refused"] == 1.0 and rows[FAMILY, "falsely_free_queried"] == 0.0
