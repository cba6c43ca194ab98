"""Corners are found where the camera sees them; a board is named by one text."""

import numpy as np
import pytest

from calibration.boards import DEFAULT_BOARD, Board, parse_board
from tests.calibration.boards import CAMERAS, photograph, poses

BOARDS = [
    "chessboard:8x6:0.108",
    DEFAULT_BOARD,
    "charuco:7x5:0.035:0.026:DICT_APRILTAG_36h11",
    "circles:7x5:0.03",
    "asymmetric_circles:4x11:0.02",
    "aprilgrid:5x4:0.03:0.3",
]
WHOLE = ("chessboard", "circles", "asymmetric_circles")  # that must be seen whole
AWAY = {"plumb_bob": (6.0, 11.0), "equidistant": (4.0, 7.0)}  # squares
NEARNESS = {"asymmetric_circles": 2.0, "aprilgrid": 0.8}  # of other boards than those of squares


def away(board: Board, model: str) -> tuple[float, float]:
    near, far = AWAY[model]
    return near * NEARNESS.get(board.kind, 1.0), far * NEARNESS.get(board.kind, 1.0)


def same_corners(board: Board, pixels: np.ndarray) -> list[np.ndarray]:
    """The pixels as they are and, of a chessboard that looks the same turned by half, in reverse."""
    return [pixels, pixels[::-1]] if board.kind in ("chessboard", "circles") else [pixels]


@pytest.mark.parametrize("text", BOARDS)
@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_corners_are_where_the_camera_sees_them(text: str, model: str) -> None:
    board, camera = parse_board(text), CAMERAS[model]
    for T in poses(camera, board, 3, 35.0, 1, away(board, model)):
        found = board.find(photograph(model, board, T))
        assert found is not None
        points, pixels = found
        assert len(points) >= (0.25 if board.kind == "aprilgrid" else 0.8) * len(board.corners)
        expected = camera.project(points @ T[:3, :3].T + T[:3, 3])
        errors = [np.linalg.norm(p - expected, axis=1) for p in same_corners(board, pixels)]
        best = min(errors, key=lambda e: float(e.sum()))
        # The middle of a circle's picture is not the picture of its middle.
        limit = 0.4 if board.radius else 0.12
        assert np.median(best) < limit and np.sqrt((best**2).mean()) < max(limit, 0.3)  # px


def test_a_part_of_a_charuco_board_is_a_view_and_a_part_of_a_chessboard_is_none() -> None:
    camera = CAMERAS["plumb_bob"]
    for text in BOARDS:
        board = parse_board(text)
        picture = photograph("plumb_bob", board, poses(camera, board, 1, 10.0, 2, away(board, "plumb_bob"))[0])
        px = board.find(picture)[1]
        picture[:, : int(np.percentile(px[:, 0], 40))] = 128
        found = board.find(picture)
        if board.kind in WHOLE:
            assert found is None
        else:
            assert found is not None and 8 <= len(found[0]) < len(board.corners)


def test_no_board_is_found_in_noise() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    assert all(parse_board(text).find(noise) is None for text in BOARDS)


@pytest.mark.parametrize("text", BOARDS)
def test_the_text_names_the_board(text: str) -> None:
    board = parse_board(text)
    assert parse_board(str(board)) == board and str(board) == text
    nx, ny = board.squares
    if board.kind in ("chessboard", "charuco"):
        assert len(board.corners) == (nx - 1) * (ny - 1)
    if board.radius:
        return
    low, high = board.dark()[:, :2].min(axis=0), board.dark()[:, 2:].max(axis=0)
    np.testing.assert_allclose([*low, *high], [0, 0, nx * board.square, ny * board.square])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("chessboard", "not understood"),
        ("chessboard:8x6", "not understood"),
        ("chessboard:8:0.1", "not understood"),
        ("chessboard:8x6:wide", "not understood"),
        ("checkerboard:8x6:0.1", "not understood"),
        ("chessboard:2x6:0.1", "3 to 100 columns"),
        ("chessboard:8x6:108", "in metres"),
        ("chessboard:8x6:nan", "in metres"),
        ("charuco:7x5:0.03:0.04:DICT_5X5_100", "give markers of"),
        ("charuco:7x5:0.04:0.03:DICT_5X5_99", "DICT_5X5_100"),
        ("chessboard:101x6:0.1", "3 to 100 columns"),
        (f"chessboard:{10**19}x6:0.1", "3 to 100 columns"),
        ("chessboard:8x6:1e-300", "in metres"),
        ("charuco:7x5:0.035:0.0349999999:DICT_5X5_100", "with a white edge"),
        ("charuco:7x5:0.035:1e-9:DICT_5X5_100", "a tenth of a square"),
        ("circles:7x5", "not understood"),
        ("aprilgrid:6x6:0.03:3", "a gap of 0.1 to 1 tags"),
        ("charuco:30x20:0.04:0.03:DICT_5X5_100", "needs 300 markers"),
    ],
)
def test_a_wrong_text_is_refused(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        parse_board(text)
    assert repr(text) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", BOARDS)
def test_a_board_that_looks_the_same_after_half_a_turn_says_so(text: str) -> None:
    board = parse_board(text)
    picture = board.picture(20)
    assert board.twofold == np.array_equal(picture, picture[::-1, ::-1])
