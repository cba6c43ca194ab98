"""Calibration boards: chessboards and ChArUco boards, named by a text, and their corners in a picture."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Fits A4, A3 and letter; found even where a part of it is hidden.
DEFAULT_BOARD = "charuco:7x5:0.035:0.026:DICT_5X5_100"
_FORMS = "chessboard:8x6:0.025 (inner corners, square in m) or charuco:7x5:0.035:0.026:DICT_5X5_100 (squares, square"
_FORMS += " and marker in m, dictionary)"
# A view of fewer corners, or of corners in a line, has no pose.
FEWEST_CORNERS = 8


@dataclass(frozen=True)
class Board:
    """A flat chequered board. Board frame: x along the columns, y along the rows, z = 0, metres."""

    kind: Literal["chessboard", "charuco"]
    columns: int  # chessboard: inner corners; charuco: squares
    rows: int
    square: float  # m
    marker: float = 0.0  # m; charuco only
    dictionary: str = ""

    def __str__(self) -> str:
        text = f"{self.kind}:{self.columns}x{self.rows}:{self.square:g}"
        return text if self.kind == "chessboard" else f"{text}:{self.marker:g}:{self.dictionary}"

    @property
    def squares(self) -> tuple[int, int]:
        """Squares along x and y."""
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the chequered area, m."""
        columns, rows = self.squares
        return columns * self.square, rows * self.square

    @cached_property
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Inner corners in the board frame (m), row by row."""
        columns, rows = (n - 1 for n in self.squares)
        x, y = np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1))
        return self.square * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def dark(self) -> Float[np.ndarray, "n 4"]:
        """The dark rectangles (x0, y0, x1, y1) in the board frame, m: squares, and the markers' modules."""
        nx, ny = self.squares
        x, y = np.meshgrid(np.arange(nx), np.arange(ny))
        at = np.column_stack([x.ravel(), y.ravel()])[((x + y) % 2 == 0).ravel()] * self.square
        rectangles = [np.column_stack([at, at + self.square])]
        if self.kind == "charuco":
            board = self._charuco
            side = board.getDictionary().markerSize + 2  # modules, with the marker's own border
            module = self.marker / side
            for number, outline in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
                image = cv2.aruco.generateImageMarker(board.getDictionary(), int(number), side)
                row, column = np.nonzero(image == 0)
                low = np.reshape(outline, (-1, 3))[:, :2].min(axis=0) + module * np.column_stack([column, row])
                rectangles.append(np.column_stack([low, low + module]))
        return np.concatenate(rectangles)

    def picture(self, px_per_square: int = 40) -> UInt8[np.ndarray, "h w"]:
        """The board as it is printed, without margin; edges to the nearest pixel."""
        columns, rows = self.squares
        image = np.full((rows * px_per_square, columns * px_per_square), 255, np.uint8)
        for x0, y0, x1, y1 in np.rint(self.dark() / self.square * px_per_square).astype(int):
            image[y0:y1, x0:x1] = 0
        return image

    def find(
        self, image: UInt8[np.ndarray, "h w *c"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]] | None:
        """Corners seen in a picture (RGB or grey): board frame (m) and pixels (x, y); None if the board is not found.

        A chessboard must be fully visible. Of a ChArUco board, any 8 corners that are not in a line suffice.
        """
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self.kind == "charuco":
            pixels, numbers = self._detector.detectBoard(grey)[:2]
            if pixels is None or numbers is None or len(numbers) < FEWEST_CORNERS:
                return None
            points = self.corners[np.ravel(numbers)]
            if np.linalg.matrix_rank(points - points.mean(axis=0), tol=self.square / 2) < 2:
                return None
            # OpenCV 4 gives these corners half a pixel off. The window must not reach a marker.
            return points, _refined(grey, pixels, (1.0 - self.marker / self.square) / 2)
        size = (self.columns, self.rows)
        found, pixels = cv2.findChessboardCorners(grey, size)
        if found:
            return self.corners, _refined(grey, pixels, 0.4)
        found, pixels = cv2.findChessboardCornersSB(grey, size)  # slower; withstands blur and shadow
        return (self.corners, np.reshape(pixels, (-1, 2)).astype(np.float64)) if found else None

    @cached_property
    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)


def _refined(grey: UInt8[np.ndarray, "h w"], pixels: np.ndarray, reach: float) -> Float[np.ndarray, "n 2"]:
    """Corners to a fraction of a pixel, in a window of `reach` times the distance of the nearest two about each."""
    pixels = np.reshape(pixels, (-1, 1, 2)).astype(np.float32)
    apart = np.linalg.norm(pixels - pixels[:, 0], axis=-1)
    window = int(np.clip(reach * np.min(apart[apart > 0]), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    refined = cv2.cornerSubPix(grey, pixels, (window, window), (-1, -1), criteria)
    return np.reshape(refined, (-1, 2)).astype(np.float64)


def parse_board(text: str) -> Board:
    """The board that a text describes: `chessboard:8x6:0.108` or `charuco:7x5:0.04:0.03:DICT_5X5_100`.

    Raises ValueError with the text, its fault, and the right form.
    """
    kind, *parts = text.split(":")
    if (kind, len(parts)) not in (("chessboard", 2), ("charuco", 4)):
        raise ValueError(f"board {text!r} is not understood; give {_FORMS}")
    try:
        columns, rows = (int(n) for n in parts[0].split("x"))
        square, marker = float(parts[1]), float(parts[2]) if kind == "charuco" else 0.0
    except ValueError:
        raise ValueError(f"board {text!r} is not understood; give {_FORMS}") from None
    if min(columns, rows) < 3 or not 0 < square < 10:
        raise ValueError(f"board {text!r} needs 3 or more columns and rows, and a square in metres; give {_FORMS}")
    if kind == "chessboard":
        return Board("chessboard", columns, rows, square)
    if not 0 < marker < square:
        raise ValueError(f"board {text!r} has markers of {marker:g} m in squares of {square:g} m; give smaller markers")
    known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and n[5].isdigit())
    if parts[3] not in known:
        raise ValueError(f"board {text!r} names no dictionary; give one of {', '.join(known)}")
    board = Board("charuco", columns, rows, square, marker, parts[3])
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, parts[3]))
    if columns * rows // 2 > len(dictionary.bytesList):
        raise ValueError(
            f"board {text!r} needs {columns * rows // 2} markers but {parts[3]} has {len(dictionary.bytesList)};"
            " give a larger dictionary"
        )
    return board
