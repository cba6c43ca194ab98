"""`farside segment`: what it draws, numbers, lists and writes, and what it says where it finds nothing."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from node.__main__ import main
from perception.sources.frame import Frame
from perception.sources.frame_folder import write_frame_folder
from tests.perception.cylinders import CAN, Cylinder, picture

THINGS = CAN, Cylinder(0.14, 0.05, 0.03, 0.08), Cylinder(-0.13, -0.05, 0.04, 0.012)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return picture(*THINGS)


@pytest.fixture
def folder(tmp_path: Path, frame: Frame) -> Path:
    write_frame_folder(tmp_path / "table", replace(frame, label=None))
    return tmp_path / "table"


def label_map(folder: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(folder / "label.png"), cv2.IMREAD_UNCHANGED), np.int32)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_objects_are_drawn_numbered_and_listed(
    folder: Path, frame: Frame, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["segment", str(folder), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "object 1" in said.out and "object 2" in said.out and "8 cm wide, 12 cm high" in said.out
    assert "object 3 is left out: lower than 2 cm" in said.err
    label = label_map(tmp_path / "out")
    assert iou(label == 1, frame.label == 1) > 0.9 and iou(label == 2, frame.label == 2) > 0.9
    drawn = cv2.imread(str(tmp_path / "out" / "segments.png"))[..., ::-1]
    shape = drawn.shape[0] // 240
    inside = drawn[::shape, ::shape][label == 1].astype(float).mean(axis=0)
    assert drawn.shape == (240 * shape, 320 * shape, 3)
    assert np.abs(inside - frame.rgb[label == 1].mean(axis=0)).max() > 20  # it is tinted


def test_a_label_map_that_was_corrected_is_taken_back(folder: Path, frame: Frame, tmp_path: Path) -> None:
    mine = np.where(frame.label == 2, 7, 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mine.png"), mine)
    args = ["segment", str(folder), "--out", str(tmp_path / "out"), "--masks", str(tmp_path / "mine.png")]
    assert main(args) == 0
    np.testing.assert_array_equal(label_map(tmp_path / "out"), mine)


def test_a_box_is_enough(folder: Path, frame: Frame, tmp_path: Path) -> None:
    v, u = np.nonzero(frame.label == 2)
    box = [u.min() - 5, v.min() - 5, u.max() + 6, v.max() + 6]
    assert main(["segment", str(folder), "--out", str(tmp_path / "out"), "--box", *map(str, box)]) == 0
    assert iou(label_map(tmp_path / "out") == 1, frame.label == 2) > 0.9


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        (["--masks", "{small}"], "small.npy is 4x4, the picture 240x320"),
        (["--masks", "nowhere.npy"], "nowhere.npy is missing"),
        (["--plane", "0", "0", "0", "1"], "plane is (0.0, 0.0, 0.0, 1.0); give a b c d"),
        (["--box", "0", "0", "9", "9"], "nothing that stands on a plane is whole in the box"),
        (["--object", "3"], "object 3 is left out: lower than 2 cm"),
        (["--colour-only"], "--box X0 Y0 X1 Y1"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture, extra: list[str], says: str
) -> None:
    np.save(tmp_path / "small.npy", np.zeros((4, 4), int))
    given = [a.format(small=tmp_path / "small.npy") for a in extra]
    assert main(["segment", str(folder), "--out", str(tmp_path / "out"), *given]) == 1
    error = capsys.readouterr().err.strip()
    assert says in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_neither_jax_nor_matplotlib_is_imported(folder: Path, tmp_path: Path) -> None:
    """They take seconds."""
    program = (
        "import sys; from node.__main__ import main;"
        f"assert main(['segment', {str(folder)!r}, '--out', {str(tmp_path / 'out')!r}]) == 0;"
        "assert not {'jax', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
