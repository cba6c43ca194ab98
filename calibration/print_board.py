"""Boards to print: PDF and PNG pages in true millimetres."""

import struct
import zlib
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.boards import Board
from foundation.whole_file import write_whole

Paper = Literal["A4", "A3", "letter"]
PAPERS: dict[str, tuple[float, float]] = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}  # mm
_MARGIN, _FOOT = 8.0, 8.0  # mm; what printers leave blank, and the strip with the ruler and the board's name
_RULER = 100.0  # mm
_PX_PER_MM = 12  # a whole number, so that the PNG states its resolution exactly
_POINT = 25.4 / 72.0  # mm


def write_target(path: Path, board: Board, paper: Paper = "A4") -> None:
    """Write a page with the board, a ruler of 100 mm and the board's name. The ending chooses: `.pdf` or `.png`.

    Raises ValueError for another ending, and where the board does not fit on the paper.
    """
    if path.suffix.lower() not in (".pdf", ".png"):
        raise ValueError(f"{path} is neither .pdf nor .png; give a name with one of these endings")
    (width, height), dark = _page(board, paper)
    note = f"{board}   print at 100%, this line is {_RULER:g} mm, measure it"
    encode = _pdf if path.suffix.lower() == ".pdf" else _png
    write_whole(path, encode(width, height, dark, note))


def _page(board: Board, paper: Paper) -> tuple[tuple[float, float], Float[np.ndarray, "n 4"]]:
    """The page's width and height, and its dark rectangles (x0, y0, x1, y1; y down), mm. The last is the ruler."""
    squares = np.array(board.squares)
    across, down = squares * board.square * 1000.0
    short, long = PAPERS[paper]
    width, height = (long, short) if across > down else (short, long)
    room = np.array([width - 2 * _MARGIN, height - 2 * _MARGIN - _FOOT])
    if across > room[0] + 1e-9 or down > room[1] + 1e-9:
        fits = np.floor((room / squares).min()) / 1000.0
        larger = next((name for name in ("A4", "A3") if name != paper and _fits(across, down, name)), None)
        advice = f", or --paper {larger}" if larger else ""
        raise ValueError(
            f"board {board} measures {across:.0f} x {down:.0f} mm but {paper} holds {room[0]:.0f} x {room[1]:.0f} mm;"
            f" give squares of {fits:g} m or less{advice}"
        )
    corner = np.array([(width - across) / 2, _MARGIN + (room[1] - down) / 2])
    ruler = [_MARGIN, height - _MARGIN - 1.0, _MARGIN + _RULER, height - _MARGIN - 0.5]
    return (width, height), np.vstack([board.dark() * 1000.0 + np.tile(corner, 2), ruler])


def _fits(across: float, down: float, paper: str) -> bool:
    short, long = PAPERS[paper]
    width, height = (long, short) if across > down else (short, long)
    return across <= width - 2 * _MARGIN and down <= height - 2 * _MARGIN - _FOOT


def _pdf(width: float, height: float, dark: Float[np.ndarray, "n 4"], note: str) -> bytes:
    """One page of filled rectangles and a line of text; the user space is scaled to millimetres with y up."""
    drawing = [f"q {1 / _POINT:.9f} 0 0 {1 / _POINT:.9f} 0 0 cm"]
    drawing += [f"{x0:.4f} {height - y1:.4f} {x1 - x0:.4f} {y1 - y0:.4f} re" for x0, y0, x1, y1 in dark]
    drawing += ["f Q", f"BT /F 8 Tf {_MARGIN / _POINT:.3f} {(_MARGIN + 2.0) / _POINT:.3f} Td ({note}) Tj ET"]
    stream = "\n".join(drawing).encode("ascii")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width / _POINT:.4f} {height / _POINT:.4f}] /Contents 4 0 R"
        " /Resources << /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
    ]
    data, offsets = b"%PDF-1.6\n", []
    for number, content in enumerate(objects, start=1):
        offsets.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    data += b"xref\n0 %d\n0000000000 65535 f \n%s" % (len(objects) + 1, table)
    start = data.index(b"xref\n0 ")
    return data + b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)


def _png(width: float, height: float, dark: Float[np.ndarray, "n 4"], note: str) -> bytes:
    """The page in grey. A pixel that an edge cuts is grey by the share that is dark, so no edge is rounded away."""
    columns, rows = round(width * _PX_PER_MM), round(height * _PX_PER_MM)
    page = np.zeros((rows, columns), np.float32)
    for x0, y0, x1, y1 in dark * _PX_PER_MM:
        top, bottom, left, right = int(y0), int(np.ceil(y1)), int(x0), int(np.ceil(x1))
        over = np.clip(np.minimum(np.arange(left, right) + 1, x1) - np.maximum(np.arange(left, right), x0), 0, 1)
        down = np.clip(np.minimum(np.arange(top, bottom) + 1, y1) - np.maximum(np.arange(top, bottom), y0), 0, 1)
        page[top:bottom, left:right] += np.outer(down, over)
    image: UInt8[np.ndarray, "h w"] = np.rint(255 * (1 - np.minimum(page, 1))).astype(np.uint8)
    at = (round(_MARGIN * _PX_PER_MM), round((height - _MARGIN - 2.0) * _PX_PER_MM))
    cv2.putText(image, note, at, cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 2, cv2.LINE_AA)
    data = cv2.imencode(".png", image)[1].tobytes()
    # OpenCV writes no resolution: a pHYs chunk (pixels per metre) goes after the header, which has 33 bytes.
    content = b"pHYs" + struct.pack(">IIB", _PX_PER_MM * 1000, _PX_PER_MM * 1000, 1)
    return data[:33] + struct.pack(">I", 9) + content + struct.pack(">I", zlib.crc32(content)) + data[33:]
