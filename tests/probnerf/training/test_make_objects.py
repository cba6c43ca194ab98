"""The plain part of the script that makes training meshes. What needs Blender is not tested: it is not installed."""

import json
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[3] / "probnerf/training/infinigen"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(SCRIPTS)
    return import_module("make_objects")


def test_a_part_of_a_run_is_balanced(script: ModuleType) -> None:
    tasks = script.round_robin(["Cup", "Book", "Fork"], first_seed=5, count=4)
    assert len({*tasks}) == 12
    for start in range(0, 12, 3):
        assert {task.factory for task in tasks[start : start + 3]} == {"Cup", "Book", "Fork"}


def test_a_run_goes_on_after_its_files_and_failures(script: ModuleType, tmp_path: Path) -> None:
    assert script.finished(tmp_path) == set()
    rows = [
        {"factory": "Cup", "seed": 0, "file": "Cup_0.ply"},
        {"factory": "Cup", "seed": 1, "file": "Cup_1.ply"},  # its file was deleted
        {"factory": "Pan", "seed": 0, "failed": "took more than 240 s"},
    ]
    (tmp_path / "Cup_0.ply").touch()
    lines = [*map(json.dumps, rows), '{"factory": "Jar", "se']  # killed while writing
    (tmp_path / "index.jsonl").write_text("\n".join(lines), encoding="utf-8")
    assert script.finished(tmp_path) == {("Cup", 0), ("Pan", 0)}


def test_surfaces_of_touching_parts_join(script: ModuleType) -> None:
    """Two tetrahedra that share a face, each with its own vertices, become one closed surface of six triangles."""
    one = import_module("one_object")
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    upper = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    vertices, joined = one.merged(
        np.concatenate([upper, upper * [1, 1, -1]]), np.concatenate([faces, faces[:, ::-1] + 4])
    )
    assert len(vertices) == 5 and len(joined) == 6
    assert one.balanced(joined) and not one.balanced(joined[1:])
    assert np.isclose(np.linalg.det(vertices[joined]).sum() / 6, 2 / 6)
