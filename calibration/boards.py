"""Calibration boards, named by a text, and their points in a picture: chessboards, markers and circles."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Fits A4, A3 and letter; found even where a part of it is hidden.
DEFAULT_BOARD = "charuco:7x5:0.035:0.026:DICT_5X5_100"
_FORMS = "chessboard:8x6:0.025 (inner corners, square in m), charuco:7x5:0.035:0.026:DICT_5X5_100 (squares, square and"
_FORMS += (
    " marker in m, dictionary), circles:7x5:0.03 (circles, distance in m), asymmetric_circles:4x11:0.02 (circles of"
)
_FORMS += " a row, rows, distance of rows in m) or aprilgrid:6x6:0.03:0.3 (tags, tag in m, gap in tags; as Kalibr's)"
_PARTS = {"chessboard": 2, "charuco": 4, "circles": 2, "asymmetric_circles": 2, "aprilgrid": 3}
_KALIBRS = "DICT_APRILTAG_36h11"
_KALIBRS_BORDER = 2  # modules; other tags have 1
_AGREE_PX = 0.5
_DISC = 0.25  # radius of a circle, of the distance to its nearest neighbour
_MOST, _SMALLEST, _LARGEST = 100, 1e-4, 10.0  # columns or rows; a square, m
# A view of fewer corners, or of corners in a line, has no pose.
FEWEST_CORNERS = 8


@dataclass(frozen=True)
class Board:
    """A flat board. Board frame: x along the columns, y along the rows (down), z = 0, metres."""

    kind: Literal["chessboard", "charuco", "circles", "asymmetric_circles", "aprilgrid"]
    columns: int  # chessboard: inner corners; charuco: squares; circles of a row; aprilgrid: tags
    rows: int
    square: float  # m; between neighbours: squares, circles, rows of asymmetric circles, tags
    marker: float = 0.0  # m; charuco and aprilgrid only
    dictionary: str = ""

    def __str__(self) -> str:
        text = f"{self.kind}:{self.columns}x{self.rows}:"
        if self.kind == "aprilgrid":
            return f"{text}{self.marker:g}:{self.square / self.marker - 1:g}"
        text += f"{self.square:g}"
        return f"{text}:{self.marker:g}:{self.dictionary}" if self.kind == "charuco" else text

    @property
    def squares(self) -> tuple[float, float]:
        """The printed area's width and height in units of `square`."""
        if self.kind == "chessboard":
            return self.columns + 1, self.rows + 1
        if self.kind == "asymmetric_circles":
            return 2 * self.columns + 1, self.rows + 1
        if self.kind == "aprilgrid":  # with a gap all around, in whose corners are squares
            gap = 1 - self.marker / self.square
            return self.columns + gap, self.rows + gap
        return self.columns, self.rows

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the printed area, m."""
        columns, rows = self.squares
        return columns * self.square, rows * self.square

    @cached_property
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """The points that are found, in the board frame (m): inner corners or centres of circles, row by row.

        Of an AprilGrid: the tags' outer corners in Kalibr's order. Its rows begin at the lower edge.
        """
        if self.kind == "aprilgrid":
            gap = self.square - self.marker
            x, y = (
                np.repeat(np.arange(n), 2) * self.square + np.tile([gap, self.square], n)
                for n in (self.columns, self.rows)
            )
            x, y = np.meshgrid(x, self.size[1] - y)
            return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        if self.kind == "asymmetric_circles":
            row, column = np.mgrid[: self.rows, : self.columns]
            at = np.column_stack([(2 * column + row % 2).ravel(), row.ravel(), np.zeros(row.size)])
            return self.square * (at + np.array([1.0, 1.0, 0.0]))
        if self.kind == "circles":
            row, column = np.mgrid[: self.rows, : self.columns]
            return self.square * np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5, np.zeros(row.size)])
        columns, rows = (int(n) - 1 for n in self.squares)
        x, y = np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1))
        return self.square * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def dark(self) -> Float[np.ndarray, "n 4"]:
        """The dark rectangles (x0, y0, x1, y1) in the board frame, m: squares, and the markers' modules."""
        if self.kind == "aprilgrid":
            return self._tags()
        if self.radius:
            return np.zeros((0, 4))
        nx, ny = (int(n) for n in self.squares)
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
        image = np.full((round(rows * px_per_square), round(columns * px_per_square)), 255, np.uint8)
        for x0, y0, x1, y1 in np.rint(self.dark() / self.square * px_per_square).astype(int):
            image[y0:y1, x0:x1] = 0
        if self.radius:
            y, x = np.indices(image.shape) + 0.5
            for at in self.corners[:, :2] / self.square * px_per_square:
                image[np.hypot(x - at[0], y - at[1]) < self.radius / self.square * px_per_square] = 0
        return image

    @property
    def twofold(self) -> bool:
        """Whether it looks the same after half a turn, so that one picture does not tell which way it lies."""
        alike = {"chessboard": (self.columns + self.rows) % 2 == 0, "asymmetric_circles": self.rows % 2 == 0}
        return alike.get(self.kind, self.kind == "circles")

    @property
    def radius(self) -> float:
        """m, of dark circles about the `corners`; 0 where the board has none."""
        apart = {"circles": self.square, "asymmetric_circles": np.sqrt(2) * self.square}
        return _DISC * float(apart.get(self.kind, 0.0))

    def _tags(self) -> Float[np.ndarray, "n 4"]:
        """The dark rectangles of an AprilGrid: tag 0 at the lower left, and a square in each corner between tags."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        side = dictionary.markerSize + 2 * _KALIBRS_BORDER
        module, gap, height = self.marker / side, self.square - self.marker, self.size[1]
        rectangles = []
        for number in range(self.columns * self.rows):
            row, column = divmod(number, self.columns)
            image = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=_KALIBRS_BORDER)[::-1, ::-1]
            down, across = np.nonzero(image == 0)
            corner = np.array([gap + column * self.square, height - (row + 1) * self.square])
            low = corner + module * np.column_stack([across, down])
            rectangles.append(np.column_stack([low, low + module]))
        x, y = np.meshgrid(np.arange(self.columns + 1), np.arange(self.rows + 1))
        low = self.square * np.column_stack([x.ravel(), y.ravel()])
        return np.concatenate([*rectangles, np.column_stack([low, low + gap])])

    def find(
        self, image: UInt8[np.ndarray, "h w *c"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]] | None:
        """Corners seen in a picture (RGB or grey): board frame (m) and pixels (x, y); None if the board is not found.

        A chessboard or a grid of circles must be fully visible. Of a ChArUco board, any 8 corners that are not in a
        line suffice, and of an AprilGrid any two tags.
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
        if self.radius:
            return self._find_circles(grey, size)
        if self.kind == "aprilgrid":
            return self._find_tags(grey)
        found, pixels = cv2.findChessboardCorners(grey, size)
        if found:
            return self.corners, _refined(grey, pixels, 0.4)
        found, pixels = cv2.findChessboardCornersSB(grey, size)  # slower; withstands blur and shadow
        return (self.corners, np.reshape(pixels, (-1, 2)).astype(np.float64)) if found else None

    def _find_circles(
        self, grey: UInt8[np.ndarray, "h w"], size: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        parameters = cv2.SimpleBlobDetector.Params()
        parameters.minArea, parameters.maxArea, parameters.minDistBetweenBlobs = 12.0, grey.size / 20, 3.0
        blobs = cv2.SimpleBlobDetector.create(parameters)
        layout = cv2.CALIB_CB_SYMMETRIC_GRID if self.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
        for flags in (layout | cv2.CALIB_CB_CLUSTERING, layout):
            found, pixels = cv2.findCirclesGrid(grey, size, flags=flags, blobDetector=blobs)
            if found:
                return self.corners, np.reshape(pixels, (-1, 2)).astype(np.float64)
        return None

    def _find_tags(self, grey: UInt8[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray] | None:
        """Tags touch squares at their corners, and are parted by chance at one size of the picture or another."""
        most: dict[int, np.ndarray] = {}
        for scale in (1, 2, 3):
            larger = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
            outlines, numbers, _ = self._detector.detectMarkers(larger)
            if numbers is None:
                continue
            for number, outline in zip(np.ravel(numbers), outlines, strict=True):
                if number < self.columns * self.rows:
                    most.setdefault(int(number), (np.reshape(outline, (4, 2)) + 0.5) / scale - 0.5)
        if 4 * len(most) < FEWEST_CORNERS:
            return None
        points, pixels = [], []
        for number, outline in sorted(most.items()):
            row, column = divmod(number, self.columns)
            first = 4 * self.columns * row + 2 * column
            above = first + 2 * self.columns
            points.append(self.corners[[first, first + 1, above, above + 1]])
            pixels.append(outline[[1, 0, 2, 3]])  # OpenCV's tags are Kalibr's turned by half; clockwise
        # A quad of touching parts may be cut far from the corner. A corner is where windows of two sizes agree.
        narrow, wide = (_refined(grey, np.concatenate(pixels), reach) for reach in (0.3, 0.6))
        again = _refined(grey, wide, 0.3)
        sure = np.maximum(*(np.linalg.norm(again - other, axis=1) for other in (narrow, wide))) < _AGREE_PX
        if sure.sum() < FEWEST_CORNERS:
            return None
        return np.concatenate(points)[sure], again[sure]

    @cached_property
    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    @cached_property
    def _detector(self) -> Any:
        if self.kind == "aprilgrid":
            parameters = cv2.aruco.DetectorParameters()
            parameters.markerBorderBits = _KALIBRS_BORDER
            parameters.adaptiveThreshWinSizeMax = 53
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
            return cv2.aruco.ArucoDetector(dictionary, parameters)
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
    """The board that a text describes, such as `chessboard:8x6:0.108` or `charuco:7x5:0.04:0.03:DICT_5X5_100`.

    Raises ValueError with the text, its fault, and the right form.
    """
    kind, *parts = text.split(":")
    if _PARTS.get(kind) != len(parts):
        raise ValueError(f"board {text!r} is not understood; give {_FORMS}")
    try:
        columns, rows = (int(n) for n in parts[0].split("x"))
        square, marker = float(parts[1]), float(parts[2]) if len(parts) > 2 else 0.0
    except ValueError:
        raise ValueError(f"board {text!r} is not understood; give {_FORMS}") from None
    if not (3 <= min(columns, rows) <= max(columns, rows) <= _MOST and _SMALLEST <= square < _LARGEST):
        raise ValueError(
            f"board {text[:80]!r} needs 3 to {_MOST} columns and rows, and a square in metres; give {_FORMS}"
        )
    if kind in ("chessboard", "circles", "asymmetric_circles"):
        return Board(cast(Any, kind), columns, rows, square)
    if kind == "aprilgrid":
        tags = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _KALIBRS)).bytesList)
        if not 0.1 <= marker <= 1 or columns * rows > tags:
            raise ValueError(f"board {text!r} needs a gap of 0.1 to 1 tags, and at most {tags} tags; give {_FORMS}")
        return Board("aprilgrid", columns, rows, square * (1 + marker), square, _KALIBRS)
    if not 0.1 * square <= marker <= 0.98 * square:
        raise ValueError(
            f"board {text!r} has markers of {marker:g} m in squares of {square:g} m; give markers of a tenth of a"
            " square or more, with a white edge"
        )
    known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
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
