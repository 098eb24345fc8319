"""The calibration board as a PDF to scale, with rulers that show whether the printer kept it."""

from __future__ import annotations

import numpy as np

from calib.board import Board

_POINTS_PER_M = 72.0 / 0.0254
_MARGIN_M = 0.012
_RULER_M = 0.008  # strip below and right of the pattern


def board_pdf(board: Board) -> bytes:
    """PDF of one page, as large as the board needs; what is printed at 100 % has its true size."""
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
