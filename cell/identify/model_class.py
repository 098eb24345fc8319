"""Common model of a kind of cables: effects added to the baseline, and a prior of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects import (
    Effect,
    effect_path,
    file_sha256,
    library,
    load_effect,
    unscreened,
)
from cell.cable.effects.base import after_number
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable
from cell.identify.parameters import ParameterSpace


@dataclass(frozen=True)
class ModelClass:
    """Effects that a kind of cable has beyond the baseline, and the prior of its parameters.

    effects     added to the baseline, their parameters fitted to each cable unless stated below
    exact       effects' parameters taken as they are: (`effect.parameter`, natural value)
    names       parameters with a Gaussian prior, as in `ParameterSpace.names`
    mean        their natural values
    covariance  of their fit coordinates: relative for those that are fitted in the logarithm

    """

    effects: tuple[type[Effect], ...] = ()
    exact: tuple[tuple[str, float], ...] = ()
    names: tuple[str, ...] = ()
    mean: tuple[float, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()

    def space(
        self,
        cable: Cable,
        gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2,
        pull_m_per_s2: float | None = None,
    ) -> ParameterSpace:
        """The parameters of one such cable, before any observation.

        pull_m_per_s2  see `ParameterSpace`; None = gravity
        raises  ValueError: a name is unknown or taken as exact, values outside their bounds, a
                covariance that is none
        """
        constants = {
            f"{e.name}.{p.name}": p.default for e in self.effects for p in e.parameters
            if not p.fitted
        }  # fmt: skip
        space = ParameterSpace.of(
            cable,
            gravity_m_per_s2=gravity_m_per_s2,
            effects=self.effects,
            exact={
                **{n: v for n, v in constants.items() if n not in self.names},
                **dict(self.exact),
            },
            pull_m_per_s2=pull_m_per_s2,
        )
        return with_prior(space, self.names, self.mean, self.covariance)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled with the files of its effects, so that another process can load them."""
        rest = (self.exact, self.names, self.mean, self.covariance)
        return _rebuilt, (tuple(source_of(e) for e in self.effects), rest)


def with_prior(
    space: ParameterSpace,
    names: Sequence[str],
    mean: Sequence[float],
    covariance: Sequence[Sequence[float]] | FloatArray,
) -> ParameterSpace:
    """The space with a Gaussian prior of some of its parameters; that of the others stays.

    mean        natural values
    covariance  of fit coordinates
    raises      ValueError: see `ModelClass.space`
    """
    if not names:
        return space
    unknown = [n for n in names if n not in space.names]
    if unknown:
        raise ValueError(f"no fitted parameters {unknown}; there are {list(space.names)}")
    if twice := [n for i, n in enumerate(names) if n in names[:i]]:
        raise ValueError(f"{twice[0]} is given twice; remove one, with its mean, row and column")
    spread = np.array(covariance, dtype=np.float64)
    if len(mean) != len(names) or spread.shape != (len(names), len(names)):
        raise ValueError(
            f"{len(names)} names, {len(mean)} means and a covariance of shape {spread.shape}: "
            "needs one mean per name, and a row and a column of the covariance"
        )
    if not _is_covariance(spread):
        raise ValueError("the covariance is not symmetric and positive definite")
    index = [space.names.index(n) for n in names]
    natural = space.natural(space.mean)
    for i, n, value in zip(index, names, mean, strict=True):
        low, high = space.natural(space.low)[i], space.natural(space.high)[i]
        if not low <= value <= high:
            unit = after_number(space.units[i])
            raise ValueError(f"{n} = {value:g}{unit}: must be {low:.3g} … {high:.3g}")
        natural[i] = value
    precision = space.precision.copy()
    precision[index, :] = 0.0
    precision[:, index] = 0.0
    precision[np.ix_(index, index)] = np.linalg.inv(spread)
    return replace(space, mean=space.coordinates(natural), precision=precision)


def _is_covariance(spread: FloatArray) -> bool:
    """Whether a matrix is symmetric and positive definite, whatever the units of its rows."""
    variance = np.diag(spread)
    if not (np.all(np.isfinite(spread)) and np.all(variance > 0.0)):
        return False
    size = np.sqrt(variance)
    correlation = spread / np.outer(size, size)
    alike = bool(np.allclose(correlation, correlation.T))
    return alike and float(np.linalg.eigvalsh(correlation).min()) > 0.0


def known_effects() -> Mapping[str, type[Effect]]:
    """Effects that need no file, by name."""
    return library() | unscreened()


def source_of(effect: type[Effect]) -> str:
    """The text that `effect_from` loads an effect by: its name, or the path of a user's file."""
    if known_effects().get(effect.name) is effect:
        return effect.name
    if effect.file is None:
        raise ValueError(f"effect {effect.name} has neither a name of the library nor a file")
    return str(effect.file.path)


def effect_from(source: str) -> type[Effect]:
    """The effect with a name of the library, or in a file; one class for one file content.

    raises  KeyError, EffectError, FileNotFoundError
    """
    if not source.endswith(".py"):
        return known_effects()[source]
    file = effect_path(source)
    return _loaded(file, file_sha256(file))


@lru_cache(maxsize=64)
def _loaded(file: Path, sha256: str) -> type[Effect]:
    return load_effect(file)


def _rebuilt(sources: tuple[str, ...], rest: tuple[Any, ...]) -> ModelClass:
    return ModelClass(tuple(effect_from(s) for s in sources), *rest)
