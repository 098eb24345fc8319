"""A held cable in a picture, measured finely: its centreline, its end at the jaw, its tip."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from calib.errors import TooFewError
from calib.plane import PlaneView
from drivers.interfaces import FloatArray

Image = NDArray[np.uint8]

#: Range of profiles beyond the jaw's edge and the tip, their half length and spacing, px.
_BEYOND_PX, _ASIDE_PX, _STEP_PX = 14.0, 6.0, 0.5
#: Distances from jaw and tip within which a profile includes them, px.
_JAW_PX, _TIP_PX = 5.0, 3.0
#: Range of the search for a line's end about its expected place, px.
_END_PX = 14.0
_LEAST_POINTS = 60
_ITERATIONS, _PROFILE_ITERATIONS = 3, 5
_FINE, _DEGREE = 800, 7  # points of a smooth line, and its polynomials' degree
#: Largest offset of a point from the line, px.
_MOST_PX = 2.5


@dataclass(frozen=True, eq=False)
class CableLine:
    """The centreline of a held cable.

    points_m  (N, 2) along it, from near the jaw to near the tip; clear of both
    along_m   (N,) their arc lengths from the jaw's edge
    smooth_m  (K, 2) the same line smoothed, evenly from edge to tip
    edge_m    (2,) its point at the jaw's edge
    tip_m     (2,) its end
    noise_px  standard deviation of a point across the line, by its roughness
    """

    points_m: FloatArray
    along_m: FloatArray
    smooth_m: FloatArray
    edge_m: FloatArray
    tip_m: FloatArray
    noise_px: float


def measure_line(
    image: Image,
    view: PlaneView,
    rough_m: FloatArray,
    jaw_rad: float,
    width_px: float,
    *,
    dark: bool,
) -> CableLine:
    """Measure a cable along a rough centreline.

    image     grey levels
    rough_m   (K, 2) points along it, from the gripping point to the tip, evenly spaced
    jaw_rad   direction of the jaw: its edge is square to it, in the plane, not in the picture
    width_px  standard deviation of its profile, blur included
    dark      whether it is darker than its background, not lighter
    raises    TooFewError: not detected along most of its length, or it does not end in the picture
    """
    picture = (-1.0 if dark else 1.0) * image.astype(np.float32)
    square_m = 1e-3 * np.array([[-np.sin(jaw_rad), np.cos(jaw_rad)], [0.0, 0.0]])
    edge_way = np.diff(view.to_pixels(rough_m[0] + square_m), axis=0)
    edge_way /= np.linalg.norm(edge_way)
    way = _Polyline.through(view.to_pixels(rough_m))
    for iteration in range(_ITERATIONS):
        offset, amplitude = _profiles(picture, way.places, way.normals, width_px)
        clear = (way.along_px > _JAW_PX) & (way.along_px < way.length_px - _TIP_PX)
        detected = (np.abs(offset) < _MOST_PX) & (amplitude > 0.4 * np.median(amplitude[clear]))
        if np.count_nonzero(detected & clear) < max(_LEAST_POINTS, 0.7 * np.count_nonzero(clear)):
            raise TooFewError(
                "the cable is seen along too little of its length",
                "see that it is lit, sharp, and all of it in the picture",
            )
        head, tail = (np.abs(way.along_px - at) < _END_PX for at in (0.0, way.length_px))
        # profiles along the jaw's edge meet all of it at once, those across the cable do not
        sides = np.broadcast_to(edge_way, (int(head.sum()), 2))
        fading = _profiles(picture, way.places[head], sides, width_px, iterations=1)[1]
        edge = -_half(-way.along_px[head][::-1], fading[::-1], width_px, 0.0)
        fading = _profiles(picture, way.places[tail], way.normals[tail], width_px, iterations=1)[1]
        tip = _half(way.along_px[tail], fading, width_px, way.length_px)
        inner = (way.along_px > edge + _JAW_PX) & (way.along_px < tip - _TIP_PX) & detected
        centres = way.places + offset[:, None] * way.normals
        if iteration < _ITERATIONS - 1:
            way = way.moved(way.along_px[inner], centres[inner], edge, tip)
    ends = [_on_line(way.along_px[inner], centres[inner], at) for at in (edge, tip)]
    rough = np.diff(offset[inner], 3) / np.sqrt(20.0)
    smooth = view.to_plane(way.moved(way.along_px[inner], centres[inner], edge, tip).dense)
    length_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    share = (way.along_px[inner] - edge) / (tip - edge)
    return CableLine(
        view.to_plane(centres[inner]),
        np.interp(share, np.linspace(0.0, 1.0, len(smooth)), length_m),
        smooth,
        view.to_plane(ends[0]),
        view.to_plane(ends[1]),
        float(1.4826 * np.median(np.abs(rough))),
    )


@dataclass(frozen=True, eq=False)
class _Polyline:
    """Places one pixel apart along a line, straight beyond both ends; along_px from its start."""

    along_px: FloatArray
    places: FloatArray
    normals: FloatArray
    length_px: float
    dense: FloatArray

    @classmethod
    def through(cls, pixels: FloatArray) -> _Polyline:
        """Through (K, 2) points without noise."""
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
        return cls._along(CubicSpline(s, pixels)(np.linspace(0.0, s[-1], _FINE)))

    def moved(self, along_px: FloatArray, points: FloatArray, edge: float, tip: float) -> _Polyline:
        """From `edge` to `tip`, fitted to measured points (N, 2) at (N,) places."""
        u = np.linspace(edge, tip, _FINE)
        fit = np.polynomial.Chebyshev.fit
        return self._along(np.stack([fit(along_px, v, _DEGREE)(u) for v in points.T], axis=1))

    @classmethod
    def _along(cls, dense: FloatArray) -> _Polyline:
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
        spline = CubicSpline(s, dense)
        along = np.arange(-_BEYOND_PX, s[-1] + _BEYOND_PX)
        on = np.clip(along, 0.0, s[-1])
        tangent = spline(on, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        places = spline(on) + (along - on)[:, None] * tangent
        normals = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        return cls(along, places, normals, float(s[-1]), dense)


def _profiles(
    picture: NDArray[np.float32],
    places: FloatArray,
    sides: FloatArray,
    width_px: float,
    iterations: int = _PROFILE_ITERATIONS,
) -> tuple[FloatArray, FloatArray]:
    """Offset across, px, and amplitude, grey levels, of a light line at each place (N, 2).

    Amplitude · exp(−(n − offset)²/2 width²) on a slope, along (N, 2) sides, by Gauss–Newton; after
    one iteration the amplitude is that at the place itself.
    """
    n = np.arange(-_ASIDE_PX, _ASIDE_PX + 0.5 * _STEP_PX, _STEP_PX)
    where = places[:, None] + n[:, None] * sides[:, None]
    values = cv2.remap(
        picture,
        where[..., 0].astype(np.float32),
        where[..., 1].astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    offset = np.zeros(len(values))
    ground = np.stack([np.ones_like(n), n / _ASIDE_PX], axis=1)
    amplitude = np.zeros(len(values))
    for _ in range(iterations):
        away = (n - offset[:, None]) / width_px
        hump = np.exp(-0.5 * away**2)
        basis = np.concatenate(
            [
                hump[..., None],
                (hump * away / width_px)[..., None],
                np.broadcast_to(ground, (*hump.shape, 2)),
            ],
            axis=-1,
        )
        normal = np.swapaxes(basis, 1, 2)
        solution = np.linalg.solve(normal @ basis, normal @ values[..., None])[..., 0]
        amplitude = solution[:, 0]
        step = np.where(amplitude > 1.0, solution[:, 1] / np.maximum(amplitude, 1.0), 0.0)
        offset = np.clip(offset + np.clip(step, -1.0, 1.0), -3.0, 3.0)
    return offset, amplitude


def _half(along: FloatArray, amplitude: FloatArray, width_px: float, expected: float) -> float:
    """Position at which the amplitude falls to half: full · Φ((end − along)/blur)."""
    from scipy.special import ndtr

    x, a = along, amplitude
    inside = np.median(a[x < expected - 0.4 * _END_PX])
    below = np.flatnonzero(a < 0.5 * inside)
    end = x[below[0]] if len(below) else np.nan
    if not np.isfinite(end):
        raise TooFewError(
            "the cable does not end where it must",
            "see that its tip and the jaw's edge are in the picture and nothing lies behind them",
        )
    blur = 0.7 * width_px
    for _ in range(8):
        z = (end - x) / blur
        share, density = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
        basis = np.stack([share, np.ones_like(x) - share, density / blur], axis=1)
        full, low, move = np.linalg.lstsq(basis, a, rcond=None)[0]
        end += float(np.clip(move / max(full - low, 1e-6), -1.0, 1.0))
    return float(end)


def _on_line(along: FloatArray, places: FloatArray, at: float) -> FloatArray:
    """(2,) extrapolation of the nearest places to `at`."""
    near = np.argsort(np.abs(along - at))[:30]
    return np.array([np.polyval(np.polyfit(along[near] - at, v, 2), 0.0) for v in places[near].T])
