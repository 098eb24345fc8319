"""Branch-free elementary functions that LLVM vectorises across lanes (libm calls do not)."""

from __future__ import annotations

import numpy as np

from cell.cable.compiling import inline

_ROUND = 6755399441055744.0  # 1.5·2⁵²: adding and subtracting rounds to the nearest integer
_EXPONENT = 4503599627370496.0 + 1023.0  # 2⁵² and the exponent's bias


@inline
def sincos(x: float) -> tuple[float, float]:
    """Sine and cosine of |x| < 1e5 to 1 ulp.  Source: Cephes `sin.c` minimax polynomials."""
    k = (x * 0.6366197723675814 + _ROUND) - _ROUND
    y = (x - k * 1.5707963267341256) - k * 6.077100506506192e-11
    quadrant = k - 4.0 * ((k * 0.25 + _ROUND) - _ROUND)  # −2 … 2
    z = y * y
    s = 1.58962301576546568060e-10
    s = s * z - 2.50507477628578072866e-8
    s = s * z + 2.75573136213857245213e-6
    s = s * z - 1.98412698295895385996e-4
    s = s * z + 8.33333333332211858878e-3
    s = s * z - 1.66666666666666307295e-1
    s = y + y * z * s
    c = -1.13585365213876817300e-11
    c = c * z + 2.08757008419747316778e-9
    c = c * z - 2.75573141792967388112e-7
    c = c * z + 2.48015872888517045348e-5
    c = c * z - 1.38888888888730564116e-3
    c = c * z + 4.16666666666665929218e-2
    c = 1.0 - 0.5 * z + z * z * c
    odd = (quadrant == 1.0) | (quadrant == -1.0)
    sine = c if odd else s
    cosine = s if odd else c
    half = (quadrant == 2.0) | (quadrant == -2.0)
    sine = -sine if (quadrant == -1.0) | half else sine
    cosine = -cosine if (quadrant == 1.0) | half else cosine
    return sine, cosine


@inline
def exponential(x: float) -> float:
    """eˣ for |x| < 700 to 1e-15 relative."""
    shifted = x * 1.4426950408889634 + _ROUND
    k = shifted - _ROUND
    r = (x * 1.4426950408889634 - k) * 0.6931471805599453
    p = 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    # the integer stands in the low bits: a conversion would be done lane by lane
    return p * np.int64((np.float64(shifted).view(np.int64) + 1023) << 52).view(np.float64)


@inline
def power(base: float, exponent: float) -> float:
    """base**exponent of a normal base > 0 to 1e-12 relative."""
    bits = np.float64(base).view(np.int64)
    mantissa = np.int64((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    two = np.int64(((bits >> 52) & 0x7FF) | 0x4330000000000000).view(np.float64) - _EXPONENT
    high = mantissa > 1.4142135623730951
    mantissa = mantissa * 0.5 if high else mantissa
    two = two + 1.0 if high else two
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    p = 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    p = p * z + 1.0
    return exponential((2.0 * s * p + two * 0.6931471805599453) * exponent)  # type: ignore[no-any-return]


@inline
def settling_time(decay: float, duration: float) -> float:
    """Factor on dz/dt for the change of z over `duration`: duration·(1 − e⁻ˣ)/x.

    Exact, however stiff, for dz/dt = rate − decay·(z − z₀); x = decay·duration.
    """
    x = decay * duration
    bounded = 500.0 if x > 500.0 else x
    bounded = -50.0 if x < -50.0 else bounded
    small = abs(x) < 1e-3
    share = 1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0))
    share = share if small else (1.0 - exponential(-bounded)) / (1.0 if small else x)
    return duration * share
