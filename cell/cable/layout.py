"""Memory layout of a block of lanes in the compiled code: field numbers of one flat array.

A block holds up to `LANES` cables ("lanes") side by side.  Field `f` of body `i` of lane `w` is
`state[(i * FIELDS + f) * LANES + w]`.  One flat array with constant strides and lanes innermost
lets LLVM see that neighbouring lanes are independent and use full vector registers.

Body 0 is the half segment in the grip, bodies 1 … n−1 are segments, body n is the half segment at
the tip; hinge `i` is the near end of body `i`.  Suffix `_C` = at the collocation time of a step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

LANES = 16
#: Lanes of a small block: a vector register of the widest kind.
VECTOR = 8
#: Numbers on a line of the processor's cache.
_CACHE_LINE = 8

# --- state ------------------------------------------------------------------------------------
BEND = 0  # bend angle φ of the hinge, rad
RATE = 1  # dφ/dt
ACCEL = 2  # the integrator's acceleration, lagging as generalised-α defines it
ACCEL_C = 3  # acceleration of the hinge in the step's equation; predictor of the next
# --- at the collocation time --------------------------------------------------------------------
BEND_C = 4
RATE_C = 5
ANGLE = 6  # absolute angle θ of the body
SPIN = 7  # dθ/dt
TX = 8  # unit tangent, away from the grip
TY = 9
PX = 10  # near end of the body
PY = 11
UX = 12  # its velocity
UY = 13
FX = 14  # effects' force per metre at the middle of the body, N/m
FY = 15
DAMP = 16  # −∂(normal force per metre)/∂(normal velocity) ≥ 0, N·s/m²
QX = 17  # predicted acceleration of the near end, and of the body's angle
QY = 18
QA = 19
MOMENT = 20  # bending moment of the hinge, N·m
STIFF = 21  # ∂moment/∂ACCEL_C
INV = 22  # of the articulated-body recursion
BIAS = 23
HX = 24
HY = 25
HA = 26
BEND_0 = 27  # bend at the start of the step, for effects with memory
# --- the cable ----------------------------------------------------------------------------------
RIGIDITY = 28  # EI, N·m²
PER_LENGTH = 29  # curvature per bend angle, 1/m
VISCOSITY = 30  # N·m²·s; of hinge 0 N·m·s/rad
POWER = 31  # (N − 1)/2
REST = 32  # rest curvature, 1/m
FREE = 33  # 1 = the hinge bends, 0 = it is rigid
SPRING = 34  # rotational stiffness that replaces the bending law (hinge 0), N·m/rad
LENGTH = 35  # of the body, m
MASS = 36  # ∫ρ ds, and ∫ρ s ds, ∫ρ s² ds from the near end
MASS_1 = 37
MASS_2 = 38
EXTRA = 39  # the same integrals of what is added to the inertia normal to the strip
EXTRA_1 = 40
EXTRA_2 = 41
WEIGHT = 42  # mass that has weight, and its first moment
WEIGHT_1 = 43
GX = 44  # gravity, m/s²
GY = 45
ARC_HINGE = 46  # arc length of the hinge and of the body's middle, m
ARC_MIDDLE = 47
FIELDS = 48

BODY = FIELDS * LANES

# --- the clamp at a step's collocation time: `base[(step * BASE_FIELDS + f) * LANES + w]` ---------
BASE_X = 0
BASE_Y = 1
BASE_ANGLE = 2
BASE_UX = 3
BASE_UY = 4
BASE_SPIN = 5
BASE_AX = 6
BASE_AY = 7
BASE_AA = 8
BASE_FIELDS = 9


def vectors(*shape: int) -> NDArray[np.float64]:
    """(shape…, LANES) zeros that begin on a cache line: none of their vectors lies on two.

    A vector on two lines takes two reads; it made a step a quarter slower.
    """
    size = math.prod(shape) * LANES
    raw = np.zeros(size + _CACHE_LINE)
    begin = -(raw.ctypes.data // raw.itemsize) % _CACHE_LINE
    return raw[begin : begin + size].reshape(*shape, LANES)
