"""Checks by the shape at rest: expected swing frequency, and position and angle at the clamp.

Neither needs a fitted model.  If the weight bends the cable, its droop gives the swing frequency,
independent of its stiffness.  The extended curve through the markers ends at the clamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from cell.cable.arrays import FloatArray
from cell.study.data import Trial
from cell.study.series import wrapped

#: Gravity in the plane below this is no scale: a level plane that is 6° off has as much, m/s².
WEAK_M_PER_S2 = 1.0
#: A uniform clamped strip that droops by δ swings at ω² = 1.545 g/δ (β₁L = 1.8751).
SWING = 1.545
#: Of a chain that hangs: ω = 2.4048/2 √(g/L), by the first zero of the Bessel function J₀.
CHAIN = 1.2024
#: A droop of less than this share of the arc length may be due to the clamp's angle.
_LEAST_DROOP = 0.05
#: To estimate the root: largest arc length of the nearest marker, share of the length; least count.
_NEAREST, _FEWEST = 0.12, 4
#: Points at which the curve is integrated.
_POINTS = 161


@dataclass(frozen=True)
class SwingScale:
    """Swing frequencies of a cable that follow from gravity, independent of its stiffness.

    slowest_hz  of a hanging chain: 1.2 √(g/L) / 2π; no cable is slower
    droops_hz   of a cantilever with a droop δ of its tip: √(1.545 g/δ) / 2π, because the same
                stiffness gives droop and restoring force; nan = δ is not visible
    droop_m     δ
    source      Euler-Bernoulli beam: δ = ρA g L⁴ / 8EI, ω² = 12.36 EI / (ρA L⁴)
    """

    slowest_hz: float
    droops_hz: float
    droop_m: float


def swing_scale(
    trial: Trial, rest: int, tip: int, arc_m: float, gravity_m_per_s2: tuple[float, float]
) -> SwingScale | None:
    """Swing frequencies of the cable up to a marker; None without gravity or an arc length.

    rest   frames at rest
    tip    number of the marker, at arc length arc_m
    """
    size = float(np.hypot(*gravity_m_per_s2))
    if size < WEAK_M_PER_S2 or not arc_m > 0.0:
        return None
    slowest_hz = CHAIN * np.sqrt(size / arc_m) / (2.0 * np.pi)
    grip, still = trial.grip, trial.markers.xy_m[:rest, tip]
    droop_m = np.nan
    if len(still) and np.isfinite(still).any(axis=0).all() and not trial.bent:
        angle = grip.angle_rad[0]
        straight = [grip.x_m[0], grip.y_m[0]] - arc_m * np.array([np.cos(angle), np.sin(angle)])
        below = (np.nanmedian(still, axis=0) - straight) @ np.array(gravity_m_per_s2) / size
        droop_m = float(below) if below > _LEAST_DROOP * arc_m else np.nan
    return SwingScale(slowest_hz, np.sqrt(SWING * size / droop_m) / (2.0 * np.pi), droop_m)


@dataclass(frozen=True)
class ClampedEnd:
    """Root of the curve through the markers at rest, relative to the trial's clamp pose.

    away_m   from the gripping point; length_m of the cable, up to its last marker
    turned_rad  angle of its direction from the clamp angle; positive = down
    worst_m  largest distance of a marker from the curve, at arc length worst_arc_m
    """

    away_m: float
    length_m: float
    turned_rad: float
    worst_m: float
    worst_arc_m: float


def clamped_end(trial: Trial, rest: int, arc_length_m: FloatArray) -> ClampedEnd | None:
    """The clamped end, by the curve through the markers; None if too few are near the clamp.

    The curvature of a cable with a free end is (1 − s/L)(a + b s): least squares of place and
    direction at s = 0, a and b.
    """
    still = trial.markers.xy_m[:rest]
    visible = np.isfinite(still).all(axis=2).any(axis=0)
    arcs = arc_length_m[visible]
    length_m = float(np.max(arcs, initial=0.0))
    near = np.isfinite(arcs).all() and length_m > 0.0 and arcs.min() <= _NEAREST * length_m
    if trial.bent or np.count_nonzero(visible) < _FEWEST or not near:
        return None
    places = np.nanmedian(still[:, visible], axis=0) / length_m
    grip = trial.grip
    clamp = np.array([grip.x_m[0], grip.y_m[0]]) / length_m
    angle = float(grip.angle_rad[0])
    away = places[np.argmin(arcs)] - clamp
    observed_angle = float(np.arctan2(-away[1], -away[0])) if np.hypot(*away) > 1e-3 else angle

    def residuals(q: FloatArray) -> FloatArray:
        return np.asarray(_curve(q, arcs / length_m) - places).ravel()

    fits = [least_squares(residuals, [*clamp, at, 0.0, 0.0]) for at in (angle, observed_angle)]
    best = min(fits, key=lambda fit: float(fit.cost)).x
    turned = wrapped(float(best[2]) - angle)
    apart = np.linalg.norm(residuals(best).reshape(-1, 2), axis=1)
    worst = int(np.argmax(apart))
    return ClampedEnd(
        float(np.hypot(*(best[:2] - clamp))) * length_m,
        length_m,
        turned,
        float(apart[worst]) * length_m,
        float(arcs[worst]),
    )


def _curve(q: FloatArray, arcs: FloatArray) -> FloatArray:
    """(arcs, 2) of a curve of length 1 that begins at q[:2] in the direction q[2]."""
    s = np.linspace(0.0, 1.0, _POINTS)
    angle = q[2] + q[3] * (s - s**2 / 2.0) + q[4] * (s**2 / 2.0 - s**3 / 3.0)
    steps = -np.column_stack([np.cos(angle), np.sin(angle)])
    middle = 0.5 * (steps[1:] + steps[:-1]) / (_POINTS - 1)
    along = np.vstack([np.zeros(2), np.cumsum(middle, axis=0)]) + q[:2]
    return np.column_stack([np.interp(arcs, s, along[:, k]) for k in range(2)])
