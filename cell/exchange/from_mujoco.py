"""A model fitted to a chain of hinges: EI(s), N and viscosity of its springs and dampers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.cable.model import knot_basis
from cell.exchange.chain import law
from cell.exchange.read_mjcf import HingeChain, read_chain
from cell.files.input_error import InputError
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace, Prior

#: Bounds of N, as those of a fit.
_EXPONENTS = (0.3, 3.0)
#: Curvatures up to half a circle at which springs are read.
_SAMPLES = 120
#: Range of plausible moments of a hinge, N·m: from a hair of a millimetre to a steel rope as thick
#: as an arm.
_MOMENTS_N_M = (1e-15, 1e6)
#: Relative error of the model's springs and dampers above which a note is written.
_NOTED = 0.01
#: Placeholder, as a file has no camera: a model's noise only scales its residual, which is 0 here.
_NOISE_M = 1e-4


@dataclass(frozen=True, eq=False)
class FittedChain:
    """The model of a chain in a file, and notes on content that the model omits."""

    model: Identified
    notes: tuple[str, ...]


def model_from_mujoco(path: Path) -> FittedChain:
    """The model of the chain in an MJCF file.

    Nothing is measured: the uncertainty is that of the weak prior.  Its frame has y up.

    raises  NoMujocoError; InputError: no chain, or a value that no cable has
    """
    chain = read_chain(path)
    notes = list(chain.notes)
    cable = Cable(chain.length_m, chain.density_kg_per_m, chain.width_m, chain.thickness_m)
    if (why := cable.implausible()) is not None:
        raise InputError.at(path, f"line_density_kg_per_m: {why}", line=chain.lines[0])
    exponent, rigidity, misfit = _bending(path, chain)
    if not rigidity.min() > 0.0:
        weak = int(np.argmin(rigidity))
        message = (
            f"hinge {weak + 1} has EI = {rigidity[weak]:.3g} N·m² with all of its springs; a "
            "cable's is above 0: see to the springs of its tendons"
        )
        raise InputError.at(path, message, line=chain.lines[weak])
    if misfit > _NOTED:
        notes.append(f"its springs follow the bending law to {misfit:.1%} only")
    log_rigidity = _at_knots(chain, rigidity, notes)
    if np.any(np.abs(chain.rest_rad) > 1e-12):
        notes.append("bends free of load (springref) are not read")
    gravity = (0.0, -chain.gravity_m_per_s2)
    space = ParameterSpace.of(cable, gravity_m_per_s2=gravity, prior=Prior(knots=len(log_rigidity)))
    viscosity = _viscosity(chain, notes)
    log_viscosity = float(np.log(viscosity)) if viscosity > 0.0 else float(space.low[-1])
    q = np.array([*log_rigidity, exponent, log_viscosity])
    _check_bounds(path, chain, space, q)
    return FittedChain(_model_without_data(space, q), tuple(notes))


def _at_knots(chain: HingeChain, rigidity: FloatArray, notes: list[str]) -> FloatArray:
    """(k,) log EI at the knots of a model, by least squares; adds a note if EI(s) is rougher."""
    knots = min(Prior().knots, len(rigidity))
    basis = knot_basis(knots, tuple(chain.arc_length_m / chain.length_m))
    log_rigidity = np.linalg.lstsq(basis, np.log(rigidity), rcond=None)[0]
    rough = float(np.abs(np.expm1(basis @ log_rigidity - np.log(rigidity))).max())
    if rough > _NOTED:
        notes.append(f"EI(s) is smoothed over {knots} knots: it differs by up to {rough:.1%}")
    return np.asarray(log_rigidity)


def _check_bounds(path: Path, chain: HingeChain, space: ParameterSpace, q: FloatArray) -> None:
    """Raise InputError if a parameter is outside the bounds of a fit."""
    for i in np.flatnonzero((q < space.low) | (q > space.high)):
        low, value, high = (float(space.natural(v)[i]) for v in (space.low, q, space.high))
        raise InputError.at(
            path,
            f"{space.names[i]} = {value:.3g} {space.units[i]}: must be {low:.3g} … {high:.3g} for "
            "a cable of this weight and length; mind the units, N·m/rad and kg",
            line=chain.lines[0],
        )


def _model_without_data(space: ParameterSpace, q: FloatArray) -> Identified:
    """A model without measurements."""
    covariance = np.linalg.inv(space.precision)
    return Identified(
        space,
        q,
        0.5 * (covariance + covariance.T),
        Noise(_NOISE_M),
        0.0,
        1.0,
        0,
        0,
        0,
        "imported",
        np.zeros_like(covariance),
    )


def _moments(path: Path, chain: HingeChain, k: FloatArray) -> FloatArray:
    """(n, …) moments of the hinges' springs at curvatures (…), 1/m; N·m.

    raises  InputError: some overflow, or are implausible for a cable
    """
    low, high = _MOMENTS_N_M
    moments = np.empty((len(chain.springs), len(k)))
    for i, (springs, length) in enumerate(
        zip(chain.springs, chain.curvature_length_m, strict=True)
    ):
        with np.errstate(over="ignore", invalid="ignore"):
            moments[i] = sum(spring(k * length) for spring in springs)
        most = float(np.abs(moments[i]).max())
        if not low < most < high:
            message = (
                f"hinge {i + 1} bent to its part of half a circle takes {most:.3g} N·m, must be "
                f"{low:g} … {high:g} N·m; mind the units of stiffness, N·m/rad"
            )
            raise InputError.at(path, message, line=chain.lines[i])
    return moments


def _bending(path: Path, chain: HingeChain) -> tuple[float, FloatArray, float]:
    """N, EI at the hinges, N·m², and their relative error of the moments, root mean square."""
    reach = np.pi / chain.length_m
    k = np.linspace(-reach, reach, _SAMPLES)
    moments = _moments(path, chain, k)

    def fitted(exponent: float) -> tuple[FloatArray, float]:
        """EI of the hinges, each by least squares, and the relative error."""
        shape = law(k, exponent)
        rigidity = moments @ shape / (shape @ shape)
        residual = moments - rigidity[:, None] * shape
        size = np.linalg.norm(moments, axis=1, keepdims=True)
        return rigidity, float(np.sqrt(np.mean((residual / size) ** 2) * len(k)))

    linear, missed = fitted(1.0)
    if missed < 1e-9:
        return 1.0, linear, missed
    exponent = float(
        minimize_scalar(
            lambda n: fitted(n)[1], bounds=_EXPONENTS, method="bounded", options={"xatol": 1e-6}
        ).x
    )
    return exponent, *fitted(exponent)


def _viscosity(chain: HingeChain, notes: list[str]) -> float:
    """C, N·m²·s, of the complete chain; adds a note if it varies."""
    each = chain.damping_n_m_s * chain.curvature_length_m
    mean = float(each.mean())
    if mean == 0.0:
        notes.append("no damping: the viscosity is the least that a model may have")
    elif np.abs(each - mean).max() > _NOTED * mean:
        notes.append(
            f"viscosity varies from {each.min():.3g} to {each.max():.3g} N·m²·s: the mean is taken"
        )
    return mean
