"""Printed boards measure what they say: the PDF by its numbers, the PNG by its stated resolution and its corners."""

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards import DEFAULT_BOARD, parse_board
from calibration.print_board import PAPERS, Paper, write_target

POINT = 25.4 / 72  # mm


@pytest.mark.parametrize(
    ("text", "paper"), [(DEFAULT_BOARD, "A4"), ("chessboard:6x8:0.025", "letter"), ("chessboard:8x6:0.03", "A3")]
)
def test_a_png_has_true_millimetres(tmp_path: Path, text: str, paper: Paper) -> None:
    board, path = parse_board(text), tmp_path / "new" / "board.png"
    write_target(path, board, paper)
    assert [p.name for p in path.parent.iterdir()] == ["board.png"]
    data = path.read_bytes()
    at = data.index(b"pHYs")
    per_metre_x, per_metre_y, unit = struct.unpack(">IIB", data[at + 4 : at + 13])
    assert per_metre_x == per_metre_y and unit == 1 and at < data.index(b"IDAT")
    page = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    size = np.array(page.shape[::-1]) / per_metre_x * 1000
    np.testing.assert_allclose(sorted(size), PAPERS[paper], atol=0.05)
    points, pixels = board.find(page)
    assert len(points) == len(board.corners)
    if np.ptp(pixels[: board.columns - 1, 0]) < np.ptp(pixels[: board.columns - 1, 1]):
        pixels = pixels[:, ::-1]
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=1) / per_metre_x
    wanted = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, wanted, atol=2e-5)  # m
    ruler = (page[-round(9.2 * per_metre_x / 1000) :] < 128).sum(axis=1).max() / per_metre_x
    assert ruler == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("text", ["circles:7x5:0.03", "asymmetric_circles:4x11:0.02", "aprilgrid:5x4:0.03:0.3"])
def test_circles_and_tags_have_true_millimetres(tmp_path: Path, text: str) -> None:
    board, path = parse_board(text), tmp_path / "board.png"
    write_target(path, board, "A4")
    page = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    page = cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    points, pixels = board.find(page)
    assert len(points) >= len(board.corners) / 2
    wanted = np.linalg.norm(points[1:] - points[0], axis=1)
    np.testing.assert_allclose(np.linalg.norm(pixels[1:] - pixels[0], axis=1) / 6000, wanted, atol=1e-4)  # m


@pytest.mark.parametrize(("text", "paper"), [(DEFAULT_BOARD, "A4"), ("chessboard:8x6:0.025", "letter")])
def test_a_pdf_has_true_millimetres(tmp_path: Path, text: str, paper: Paper) -> None:
    board, path = parse_board(text), tmp_path / "board.pdf"
    write_target(path, board, paper)
    data = path.read_bytes()
    assert data.startswith(b"%PDF-1.") and data.endswith(b"%%EOF\n")
    # The catalogue that the table leads to asks viewers not to scale.
    start = int(data.split(b"startxref\n")[1].split()[0])
    offsets = [int(offset) for offset in re.findall(rb"^(\d{10}) \d{5} [nf]", data[start:], re.M)]
    root = int(re.search(rb"/Root (\d+) 0 R", data)[1])
    catalogue = data[offsets[root] :].split(b"endobj")[0]
    assert catalogue.startswith(b"%d 0 obj" % root) and re.search(rb"/PrintScaling\s*/None", catalogue)
    box = np.array(re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data).groups(), float) * POINT
    np.testing.assert_allclose(sorted(box), PAPERS[paper], atol=1e-3)
    page = zlib.decompress(data.split(b"stream\n", 1)[1].split(b"\nendstream")[0])
    number = rb"(-?[\d.]+)"
    side = rb"\s+" + number + rb" " + number + rb" l"
    corners = re.findall(number + rb" " + number + rb" m" + 3 * side + rb"\s+(?:[\d. l]+)?h", page)
    quads = np.array(corners, float).reshape(-1, 4, 2) * POINT
    quads = quads[(np.ptp(quads, axis=1) < box - 1.0).any(axis=1)]  # without the page's own
    rectangles = np.hstack([quads.min(axis=1), np.ptp(quads, axis=1)])
    dark, ruler = rectangles[:-1], rectangles[-1]
    assert ruler[2] == pytest.approx(100.0, abs=1e-3)
    # y is up in a PDF and down on a board.
    low, high = dark[:, :2].min(axis=0), (dark[:, :2] + dark[:, 2:]).max(axis=0)
    np.testing.assert_allclose((high - low) / 1000, np.array(board.squares) * board.square, atol=1e-6)
    assert (low > 7.9).all() and (high < box - 7.9).all()
    found = np.column_stack([dark[:, 0] - low[0], high[1] - dark[:, 1] - dark[:, 3], dark[:, 2:]]) / 1000
    wanted = board.dark()
    np.testing.assert_allclose(found, np.column_stack([wanted[:, :2], wanted[:, 2:] - wanted[:, :2]]), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("chessboard:8x6:0.035", "a.pdf", "315 x 245 mm but A4 .* 0.026 m or less, or --paper A3"),
        ("chessboard:8x6:0.108", "a.pdf", "give squares of 0.026 m or less$"),
        (DEFAULT_BOARD, "a.jpg", "neither .pdf nor .png"),
    ],
)
def test_what_cannot_be_printed_is_refused(tmp_path: Path, text: str, name: str, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        write_target(tmp_path / name, parse_board(text))
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
