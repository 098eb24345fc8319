"""The calibration board: a ChArUco pattern, its corners and rectangles, detection and printing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import WrongBoardError
from calib.lens import Lens
from drivers.interfaces import FloatArray

Image = NDArray[np.uint8]

_DICTIONARIES = {
    name: getattr(cv2.aruco, f"DICT_{name}")
    for name in ("4X4_50", "4X4_100", "4X4_250", "5X5_100", "5X5_250", "6X6_250")
}
#: Fewest corners of a detected board.
LEAST_CORNERS = 8


@dataclass(frozen=True)
class Board:
    """A ChArUco board.  Its frame: origin at the upper left corner, x right, y down, z behind it.

    columns, rows  squares across and down
    square_m       side of a square, as *measured* on the printout
    marker_share   side of a marker / side of a square
    legacy         pattern of OpenCV before 4.6 and of some makers: with an even number of rows
                   the colours are exchanged
    """

    columns: int = 12
    rows: int = 9
    square_m: float = 0.02
    marker_share: float = 0.75
    dictionary: str = "4X4_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.dictionary not in _DICTIONARIES:
            raise ValueError(
                f"board.dictionary = {self.dictionary!r}: must be one of {', '.join(_DICTIONARIES)}"
            )
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"board is {self.columns} × {self.rows}: must be at least 3 × 3")
        if not (self.square_m > 0.0 and 0.3 <= self.marker_share <= 0.9):
            raise ValueError(
                f"board.square_m = {self.square_m}, marker_share = {self.marker_share}: "
                "must be > 0, and 0.3 … 0.9"
            )
        held = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[self.dictionary]).bytesList
        if self.columns * self.rows // 2 > len(held):
            raise ValueError(
                f"board of {self.columns} × {self.rows} needs {self.columns * self.rows // 2} "
                f"markers, dictionary {self.dictionary} has {len(held)}; take a larger dictionary"
            )

    @cached_property
    def pattern(self) -> Any:
        """OpenCV's own board."""
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square_m,
            self.marker_share * self.square_m,
            cv2.aruco.getPredefinedDictionary(_DICTIONARIES[self.dictionary]),
        )
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def corners_m(self) -> FloatArray:
        """((columns − 1)(rows − 1), 3) inner corners by their id, z = 0."""
        return np.asarray(self.pattern.getChessboardCorners(), dtype=np.float64)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the pattern."""
        return self.columns * self.square_m, self.rows * self.square_m

    def black_m(self) -> FloatArray:
        """(P, 4, 2) black rectangles of the pattern, x and y in the board's frame, m."""
        side, marker = self.square_m, self.marker_share * self.square_m
        margin = 0.5 * (side - marker)
        dictionary = self.pattern.getDictionary()
        bits = dictionary.markerSize + 2
        marked = {}
        for corners, number in zip(self.pattern.getObjPoints(), self.pattern.getIds(), strict=True):
            cell = np.rint((np.min(corners[:, :2], axis=0) - margin) / side).astype(int)
            marked[tuple(cell.tolist())] = int(number)
        boxes = []
        for row in range(self.rows):
            for column in range(self.columns):
                left, top = column * side, row * side
                if (column, row) not in marked:
                    boxes.append((left, top, left + side, top + side))
                    continue
                image = cv2.aruco.generateImageMarker(dictionary, marked[column, row], bits)
                step = marker / bits
                for j, line in enumerate(image):
                    for first, last in _runs(line == 0):
                        x, y = left + margin, top + margin + j * step
                        boxes.append((x + first * step, y, x + last * step, y + step))
        x0, y0, x1, y1 = np.array(boxes).T
        corners_m = [np.stack(p, axis=1) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        return np.stack(corners_m, axis=1)


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board that were detected in a picture.

    name     of the picture
    ids      (N,) of the corners
    pixels   (N, 2) column, row
    size_px  width and height of the picture
    blur_px  standard deviation of the blur of edges at the corners, the median
    """

    name: str
    ids: NDArray[np.int64]
    pixels: FloatArray
    size_px: tuple[int, int]
    blur_px: float = 0.0


def find_board(
    image: Image, board: Board, name: str = "picture", lens: Lens | None = None
) -> BoardView | None:
    """The board's corners in a picture; None if fewer than `LEAST_CORNERS` are detected.

    lens    if known, it improves the detection of corners, above all in a distorted picture
    raises  WrongBoardError: another board, or a mirrored picture
    """
    parameters = cv2.aruco.CharucoParameters()
    if lens is not None:
        parameters.cameraMatrix = lens.matrix
        parameters.distCoeffs = lens.numbers[4:]
    detector = cv2.aruco.CharucoDetector(board.pattern, parameters)
    pixels, ids, _, marker_ids = detector.detectBoard(image)
    if ids is None or len(ids) < LEAST_CORNERS:
        _check_pattern(image, board, name, 0 if marker_ids is None else marker_ids)
        return None
    height, width = image.shape[:2]
    corners = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    numbers = np.asarray(ids, dtype=np.int64).ravel()
    return BoardView(name, numbers, corners, (width, height), edge_blur_px(image, corners))


def edge_blur_px(image: Image, pixels: FloatArray) -> float:
    """Standard deviation of the blur of edges near (N, 2) pixels, px; the median.

    An edge of height h blurred by a Gaussian σ is h / (σ √2π) steep at most.
    """
    blurs, reach_px = [], 6
    for u, v in np.rint(pixels).astype(int).tolist():
        part = image[
            max(0, v - reach_px) : v + reach_px + 1, max(0, u - reach_px) : u + reach_px + 1
        ]
        if min(part.shape) < reach_px:
            continue
        levels = part.astype(np.float32)
        down, across = np.gradient(levels)
        low, high = np.percentile(levels, [5.0, 95.0])
        steepest = float(np.percentile(np.hypot(down, across), 98.0))
        if steepest > 0.0:
            blurs.append(float(high - low) / (steepest * np.sqrt(2.0 * np.pi)))
    return float(np.median(blurs)) if blurs else float("nan")


def _check_pattern(image: Image, board: Board, name: str, marker_ids: Any) -> None:
    """Raises WrongBoardError: the markers are not those of this board."""
    ids = np.asarray(marker_ids).ravel()
    mirrored = cv2.aruco.CharucoDetector(board.pattern).detectBoard(image[:, ::-1].copy())[1]
    if mirrored is not None and len(mirrored) >= LEAST_CORNERS:
        raise WrongBoardError(
            f"{name}: the picture is mirrored",
            "switch mirroring off in the camera, or look at the board itself, not in a mirror",
        )
    if ids.size >= 6:
        other = Board(**{**_described(board), "legacy": not board.legacy})
        swapped = cv2.aruco.CharucoDetector(other.pattern).detectBoard(image)[1]
        hint = (
            f"set the board's `legacy` to {not board.legacy}"
            if swapped is not None and len(swapped) >= LEAST_CORNERS
            else f"describe the board as it is, or show the one of {board.columns} × {board.rows}"
        )
        raise WrongBoardError(f"{name}: {ids.size} markers, but no corners of this board", hint)
    for other_name in _DICTIONARIES:
        family = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[other_name])
        detected = cv2.aruco.ArucoDetector(family).detectMarkers(image)[1]
        if other_name != board.dictionary and detected is not None and len(detected) >= 6:
            raise WrongBoardError(
                f"{name}: shows markers of dictionary {other_name}, not {board.dictionary}",
                "describe the board as it is, or show the other one",
            )


def _described(board: Board) -> dict[str, Any]:
    names = ("columns", "rows", "square_m", "marker_share", "dictionary", "legacy")
    return {name: getattr(board, name) for name in names}


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Black runs of a row of cells: first cell, and the one after the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


_POINTS_PER_M = 72.0 / 0.0254
_MARGIN_M = 0.012
_RULER_M = 0.008  # strip below and right of the pattern


def board_pdf(board: Board) -> bytes:
    """PDF of one page, as large as the board needs; printed at 100 % it has its true size."""
    width, height = board.size_m
    page = (width + 2 * _MARGIN_M + _RULER_M, height + 2 * _MARGIN_M + 2 * _RULER_M)
    left, top = _MARGIN_M, page[1] - _MARGIN_M
    parts = ["0 g"]
    for x0, y0, x1, y1 in _boxes(board.black_m()):
        parts.append(_rectangle(left + x0, top - y1, x1 - x0, y1 - y0))
    bottom = top - height - 0.003
    across = 0.01 * np.arange(int(width / 0.01 + 1e-6) + 1)
    for k, x in enumerate(across):
        parts.append(_line(left + x, bottom, left + x, bottom - (0.004 if k % 5 == 0 else 0.002)))
    right = left + width + 0.003
    for k, y in enumerate(0.01 * np.arange(int(height / 0.01 + 1e-6) + 1)):
        parts.append(_line(right, top - y, right + (0.004 if k % 5 == 0 else 0.002), top - y))
    parts.append(_line(left, bottom, left + across[-1], bottom))
    words = (
        f"ChArUco {board.columns} x {board.rows}, {board.dictionary}"
        f"{', legacy' if board.legacy else ''}, squares {board.square_m * 1e3:g} mm, markers "
        f"{board.marker_share * board.square_m * 1e3:g} mm. Print at 100 %, on a flat stiff plate."
    )
    check = (
        f"Check: both rulers have a tick every 10 mm; this one is {across[-1] * 1e3:g} mm long. "
        "Measure ten squares or more, and give --square-mm what you measured."
    )
    parts.append(_text(left, bottom - 0.008, words))
    parts.append(_text(left, bottom - 0.012, check))
    return _document("\n".join(parts), page)


def _boxes(corners_m: np.ndarray) -> np.ndarray:
    return np.concatenate([corners_m.min(axis=1), corners_m.max(axis=1)], axis=1)


def _rectangle(x: float, y: float, width: float, height: float) -> str:
    numbers = " ".join(f"{v * _POINTS_PER_M:.4f}" for v in (x, y, width, height))
    return f"{numbers} re f"


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    a = " ".join(f"{v * _POINTS_PER_M:.4f}" for v in (x0, y0))
    b = " ".join(f"{v * _POINTS_PER_M:.4f}" for v in (x1, y1))
    return f"0.4 w {a} m {b} l S"


def _text(x: float, y: float, words: str) -> str:
    escaped = words.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    return f"BT /F 7 Tf {x * _POINTS_PER_M:.3f} {y * _POINTS_PER_M:.3f} Td ({escaped}) Tj ET"


def _document(content: str, page_m: tuple[float, float]) -> bytes:
    box = " ".join(f"{v * _POINTS_PER_M:.3f}" for v in page_m)
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {box}] /Contents 4 0 R "
        "/Resources << /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
    ]
    out = b"%PDF-1.4\n"
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += f"{number} 0 obj\n{body}\nendobj\n".encode("ascii")
    start = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode("ascii")
    for place in places:
        out += f"{place:010d} 00000 n \n".encode("ascii")
    trailer = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n"
    return out + trailer.encode("ascii")
