"""Boards to print: PDF and PNG pages in true millimetres."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_pdf import Name, PdfFile, RendererPdf
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D

from calibration.boards import Board
from foundation.whole_file import whole_file

Paper = Literal["A4", "A3", "letter"]
PAPERS: dict[str, tuple[float, float]] = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}  # mm
_MARGIN, _FOOT = 8.0, 8.0  # mm; what printers leave blank, and the strip with the ruler and the board's name
_RULER = 100.0  # mm
_PX_PER_MM = 12  # a whole number, so that the PNG states its resolution exactly
_INCH = 25.4  # mm


def write_target(path: Path, board: Board, paper: Paper = "A4") -> None:
    """Write a page with the board, a ruler of 100 mm and the board's name. The ending chooses: `.pdf` or `.png`.

    Raises ValueError for another ending, and where the board does not fit on the paper.
    """
    if path.suffix.lower() not in (".pdf", ".png"):
        raise ValueError(f"{path} is neither .pdf nor .png; give a name with one of these endings")
    (width, height), dark, discs = _page(board, paper)
    note = f"{board}   print at 100%, this line is {_RULER:g} mm, measure it"
    write = _write_pdf if path.suffix.lower() == ".pdf" else _write_png
    with whole_file(path) as part:
        write(part, width, height, dark, discs, note)


def _page(board: Board, paper: Paper) -> tuple[tuple[float, float], Float[np.ndarray, "n 4"], Float[np.ndarray, "m 4"]]:
    """The page's width and height, and its dark rectangles and discs, by their boxes (x0, y0, x1, y1; y down), mm.

    The last rectangle is the ruler.
    """
    squares = np.array(board.squares)
    across, down = squares * board.square * 1000.0
    short, long = PAPERS[paper]
    width, height = (long, short) if across > down else (short, long)
    room = np.array([width - 2 * _MARGIN, height - 2 * _MARGIN - _FOOT])
    if across > room[0] + 1e-9 or down > room[1] + 1e-9:
        fits = (
            np.floor((room / squares).min() * (board.marker / board.square if board.kind == "aprilgrid" else 1)) / 1000
        )
        larger = next((name for name in ("A4", "A3") if name != paper and _fits(across, down, name)), None)
        advice = f", or --paper {larger}" if larger else ""
        raise ValueError(
            f"board {board} measures {across:.0f} x {down:.0f} mm but {paper} holds {room[0]:.0f} x {room[1]:.0f} mm;"
            f" give {'tags' if board.kind == 'aprilgrid' else 'squares'} of {fits:g} m or less{advice}"
        )
    corner = np.array([(width - across) / 2, _MARGIN + (room[1] - down) / 2])
    ruler = [_MARGIN, height - _MARGIN - 1.0, _MARGIN + _RULER, height - _MARGIN - 0.5]
    at = board.corners[:, :2] if board.radius else np.zeros((0, 2))
    discs = np.column_stack([at - board.radius, at + board.radius]) * 1000.0 + np.tile(corner, 2)
    return (width, height), np.vstack([board.dark() * 1000.0 + np.tile(corner, 2), ruler]), discs


def _fits(across: float, down: float, paper: str) -> bool:
    short, long = PAPERS[paper]
    width, height = (long, short) if across > down else (short, long)
    return across <= width - 2 * _MARGIN and down <= height - 2 * _MARGIN - _FOOT


def _drawn(
    width: float, height: float, dark: Float[np.ndarray, "n 4"], discs: Float[np.ndarray, "m 4"], note: str
) -> Figure:
    """A page, mm; its axes are in mm too, y down."""
    figure = Figure(figsize=(width / _INCH, height / _INCH))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0), frame_on=False, xticks=(), yticks=())
    shapes = [
        Outline.unit_rectangle().transformed(Affine2D().scale(x1 - x0, y1 - y0).translate(x0, y0))
        for x0, y0, x1, y1 in dark
    ]
    shapes += [
        Outline.unit_circle().transformed(Affine2D().scale((x1 - x0) / 2).translate((x0 + x1) / 2, (y0 + y1) / 2))
        for x0, y0, x1, y1 in discs
    ]
    # One path, so that no seam shows between neighbours. Not snapped to pixels, so that no edge is rounded.
    axes.add_patch(PathPatch(Outline.make_compound_path(*shapes), color="black", linewidth=0, snap=False))
    axes.text(_MARGIN, height - _MARGIN - 2.0, note, fontsize=8)
    return figure


def _write_pdf(path: Path, width: float, height: float, dark: np.ndarray, discs: np.ndarray, note: str) -> None:
    figure = _drawn(width, height, dark, discs, note)
    figure.dpi = 72.0
    file = PdfFile(path, metadata={"CreationDate": None})
    try:
        file.newPage(*figure.get_size_inches())
        renderer = RendererPdf(file, figure.dpi, height / _INCH, width / _INCH)
        figure.draw(renderer)
        renderer.finalize()
        file.endStream()
        # the catalogue again, so that viewers print at 100%
        catalogue = {"Type": Name("Catalog"), "Pages": file.pagesObject}
        file.writeObject(file.rootObject, {**catalogue, "ViewerPreferences": {"PrintScaling": Name("None")}})
        file.finalize()
    finally:
        file.close()


def _write_png(path: Path, width: float, height: float, dark: np.ndarray, discs: np.ndarray, note: str) -> None:
    """A pixel that an edge cuts is grey by the share that is dark."""
    width, height = round(width * _PX_PER_MM) / _PX_PER_MM, round(height * _PX_PER_MM) / _PX_PER_MM  # whole pixels
    _drawn(width, height, dark, discs, note).savefig(path, format="png", dpi=_PX_PER_MM * _INCH)
