"""Edits that default tests once let pass: each is made in a copy of the checkout, where its test must fail.

    .venv/bin/pytest -m nightly tests/test_mutations.py

An edit whose source has moved on fails here, too, and wants its text renewed.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
COPIED = (
    "calibration",
    "probnerf",
    "perception",
    "node",
    "launch",
    "benchmarks",
    "examples",
    "tests",
    "pyproject.toml",
)


class Mutation(NamedTuple):
    """A piece of a file, what it is replaced with, and the test that must see it."""

    file: str
    old: str
    new: str
    test: str


TRACKER_TEST = "tests/perception/inference/test_tracker.py::test_things_keep_their_names_and_places"
MUTATIONS = {
    "half the diagonal doubled": Mutation(
        "perception/observation/visibility.py",
        "np.sqrt(3.0) / grid",
        "2.0 * np.sqrt(3.0) / grid",
        "tests/properties/test_seen.py::test_a_voxel_is_seen",
    ),
    "an error that caution leaves alone": Mutation(
        "perception/answers/query.py",
        "(1 - CAUTION) * se",
        "se",
        "tests/perception/answers/test_query.py::test_an_error_is_scaled",
    ),
    "a camera's move the other way": Mutation(
        "perception/inference/tracker.py",
        "np.linalg.inv(now.T_world_camera) @ first.T_world_camera",
        "now.T_world_camera @ np.linalg.inv(first.T_world_camera)",
        TRACKER_TEST,
    ),
    "a camera's move undone": Mutation(
        "perception/inference/tracker.py",
        "np.linalg.inv(now.T_world_camera) @ first.T_world_camera",
        "np.linalg.inv(first.T_world_camera) @ now.T_world_camera",
        TRACKER_TEST,
    ),
    "samples taken at the start of their steps": Mutation(
        "probnerf/sampling/populations.py",
        "(np.arange(each) + 0.5) / each",
        "np.arange(each) / each",
        "tests/properties/test_samples.py::test_no_as_many_equal_samples",
    ),
    "samples taken all at one place": Mutation(
        "probnerf/sampling/populations.py",
        "(np.arange(each) + 0.5) / each",
        "np.full(each, 0.5)",
        "tests/properties/test_samples.py::test_no_as_many_equal_samples",
    ),
    "a foot judged by the noise of 1 m": Mutation(
        "perception/observation/standing.py",
        "config.base * growth",
        "config.base",
        "tests/perception/observation/test_segmentation.py::test_what_belongs_to_a_foot",
    ),
    "step sizes that follow the particles they move": Mutation(
        "probnerf/sampling/tempered_smc.py",
        "(chain, tuned[:, ::-1])",
        "(chain, tuned)",
        "tests/probnerf/sampling/test_laws.py::test_the_law_holds[smc_moves_each_half",
    ),
    "an offset of the ranges with the other sign": Mutation(
        "probnerf/shapes.py",
        "observation.range - offset",
        "observation.range + offset",
        "tests/probnerf/test_shapes.py::test_a_bias_of_the_ranges",
    ),
    "the place's widths of the last view": Mutation(
        "probnerf/types.py",
        "pose_sigma=observations[0].pose_sigma",
        "pose_sigma=observations[-1].pose_sigma",
        "tests/probnerf/sampling/test_update.py::test_joined_views",
    ),
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkout, as far as tests need it."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "results"))
        else:
            shutil.copy2(ROOT / name, folder / name)
    return folder


def outcome(folder: Path, test: str) -> tuple[int, str]:
    """pytest's exit status and output for the tests whose name begins so."""
    path, name = test.split("::")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n",
        "0",
        "-q",
        "-p",
        "no:cacheprovider",
        path,
        "-k",
        name.split("[")[-1],
    ]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return ended.returncode, ended.stdout + ended.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("name", MUTATIONS)
def test_an_edit_that_was_overlooked_is_seen(name: str, copy: Path) -> None:
    edit = MUTATIONS[name]
    path = copy / edit.file
    source = path.read_text(encoding="utf-8")
    assert source.count(edit.old) == 1, f"{edit.file} holds {edit.old!r} {source.count(edit.old)} times: renew the edit"
    path.write_text(source.replace(edit.old, edit.new), encoding="utf-8")
    try:
        status, said = outcome(copy, edit.test)
    finally:
        path.write_text(source, encoding="utf-8")
    assert status == 1, said  # 1: a test ran and failed
    assert "\nFAILED " in said, said  # not an error outside the test


@pytest.mark.nightly
def test_without_an_edit_the_same_tests_pass(copy: Path) -> None:
    for test in sorted({edit.test for edit in MUTATIONS.values()}):
        status, said = outcome(copy, test)
        assert status == 0, said
