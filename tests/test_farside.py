"""The public API: light to import, NumPy in and out, the command line's answers and errors."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import farside
from farside import api
from perception.answers.query import query
from tests.node.mugs import mug_hypotheses, table_frame
from tests.node.pretend_inference import Asked

BOX = farside.Box((-0.02, -0.02, 0.0), (0.02, 0.02, 0.05))


@pytest.fixture(scope="module")
def frame() -> farside.Frame:
    return table_frame()


@pytest.fixture
def scene(frame: farside.Frame) -> farside.Scene:
    return farside.Scene((mug_hypotheses(frame, farside.segment(frame, 1)[0], [1.0, -1.0], [0.75, 0.25], 16),))


def test_the_import_takes_no_heavy_library_along() -> None:
    heavy = "import sys, farside; print({'jax', 'cv2', 'scipy'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True).stdout == "set()\n"


def test_every_name_is_there_and_another_one_is_refused() -> None:
    assert all(getattr(farside, name) is getattr(api, name) for name in api.__all__)
    assert set(api.__all__) <= set(dir(farside))
    with pytest.raises(AttributeError, match="has no attribute 'guess'; it has Box, Camera"):
        farside.guess  # noqa: B018


def test_version_is_that_of_the_distribution() -> None:
    for command in (["-m", "farside", "--version"], ["-m", "node", "--version"]):
        done = subprocess.run([sys.executable, *command], capture_output=True, text=True)
        assert done.stdout == f"farside {version('farside')}\n", done.stderr


def test_a_frame_is_made_from_arrays(frame: farside.Frame) -> None:
    made = farside.Frame(frame.rgb, frame.depth, frame.camera.K)
    np.testing.assert_array_equal(made.camera.K, frame.camera.K)
    assert (made.camera.width, made.camera.height) == frame.rgb.shape[1::-1] and not made.camera.distortion.any()
    with pytest.raises(ValueError, match="align depth to colour"):
        farside.Frame(frame.rgb, frame.depth[1:], frame.camera.K)


def test_a_question_is_the_command_lines(scene: farside.Scene) -> None:
    answer = farside.query(scene, BOX, "object", now_ns=0)
    assert answer == query(list(scene), BOX, "object", now_ns=0)
    assert answer.verdict(risk=0.05) in ("free", "occupied", "unsure")
    assert farside.query(scene[0], BOX, "object", now_ns=0) == answer  # one object is a scene
    assert farside.next_views(scene, count=2).T_object_camera.shape == (2, 4, 4)


def test_what_is_saved_is_loaded(scene: farside.Scene, frame: farside.Frame, tmp_path: Path) -> None:
    (path,) = farside.save(tmp_path, scene, frame)
    assert path.name == "object_1.npz"
    loaded = farside.load(tmp_path)
    np.testing.assert_array_equal(loaded.by_id(1).opacity, scene[0].opacity)
    np.testing.assert_array_equal(farside.read_frame(tmp_path / "frame").rgb, frame.rgb)
    with pytest.raises(ValueError, match="the scene has no object 2; its objects: 1"):
        loaded.by_id(2)


def test_estimate_tells_its_progress_and_names_what_it_leaves_out(
    frame: farside.Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    class StandIn(Asked):
        def __call__(self, frame, found, prior, config, **asked):
            if found.id == 1:
                raise ValueError("object 1 measures 90 cm")
            asked["callbacks"].on_stage(farside.StageInfo)
            return super().__call__(frame, found, prior, farside.ControllerConfig(), **asked)

    monkeypatch.setattr(api, "inference_of", StandIn())
    both = [farside.segment(frame, 1)[0]] * 2
    object.__setattr__(second := farside.Segment(**vars(both[1])), "id", 2)
    scene = farside.estimate(frame, [both[0], second], prior=object(), on_progress=lambda i, info: calls.append(i))
    assert [h.object_id for h in scene] == [2] and calls == [2]
    assert scene.left_out == {1: "object 1 measures 90 cm"}
    with pytest.raises(ValueError, match="measures 90 cm"):
        farside.estimate(frame, both[0], prior=object())


def test_what_cannot_be_meant_is_refused_with_the_remedy(frame: farside.Frame) -> None:
    with pytest.raises(ValueError, match="give metres"):
        farside.Frame(frame.rgb, 1000 * np.nan_to_num(frame.depth), frame.camera.K)
    with pytest.raises(ValueError, match=r"label map to the frame: farside.Frame\(..., label=labels\)"):
        farside.estimate(frame, np.zeros((2, 2), int))
    with pytest.raises(ValueError, match="budget_s is -2; give more than 0"):
        farside.estimate(frame, budget_s=-2)
