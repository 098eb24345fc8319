"""Result of identification: the cable's model, its covariance, and the data behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.geometry import Cable
from cell.cable.model import CableModel, knot_basis
from cell.identify.gaussian import covariance_root
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace, Prior

FORMAT = "identified-cable/1"


@dataclass(frozen=True, eq=False)
class Identified:
    """One cable's parameters with their uncertainty.

    space           what the coordinates mean
    mean            (p,) fit coordinates (log EI at knots, N, log C, effects' parameters)
    covariance      (p, p) of them: widened by `inflation`, gripper's errors included
    noise           of the measurement, as used
    residual_rms_m  measured − predicted, per coordinate, over all frames used, m
    inflation       variance factor for residuals larger or more autocorrelated than the noise; ≥ 1
    frames_used, frames_total   frames with at least one marker observed, and all
    iterations      batches of simulations
    method          "map" or "paper"; "imported" if nothing was measured
    gripper_covariance  (p, p) part of `covariance` from errors of the gripper and the simulation
    model_error_m   residual at the tip beyond the noise, root mean square, m
    converged       False: the last model of the search, not a minimum
    lacks           effects that would explain the residual: `covariance` allows for them
    """

    space: ParameterSpace
    mean: FloatArray
    covariance: FloatArray
    noise: Noise
    residual_rms_m: float
    inflation: float
    frames_used: int
    frames_total: int
    iterations: int
    method: Literal["map", "paper", "imported"]
    gripper_covariance: FloatArray
    model_error_m: float = 0.0
    converged: bool = True
    lacks: tuple[str, ...] = ()

    @property
    def model(self) -> CableModel:
        """The cable with the most probable parameters."""
        return self.space.model(self.mean)

    @property
    def values(self) -> FloatArray:
        """(p,) most probable natural values, in the order of `space.names`."""
        return self.space.natural(self.mean)

    def interval(self, confidence: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """(p,), (p,) low and high natural values of every parameter on its own."""
        reach = float(normal_quantile(0.5 + 0.5 * confidence)) * np.sqrt(np.diag(self.covariance))
        low = np.clip(self.mean - reach, self.space.low, self.space.high)
        high = np.clip(self.mean + reach, self.space.low, self.space.high)
        return self.space.natural(low), self.space.natural(high)

    def samples(self, count: int, seed: int = 0) -> FloatArray:
        """(count, p) coordinates drawn from the distribution of the parameters, within bounds."""
        return self._at(np.random.default_rng(seed).normal(size=(count, len(self.mean))))

    def rigidity_log_std(self, arc_length_m: ArrayLike) -> FloatArray:
        """(n,) standard deviation of log EI(s) at arc lengths from the gripping point (n,), m."""
        k = self.space.knots
        fraction = np.asarray(arc_length_m, dtype=np.float64) / self.space.cable.free_length_m
        basis = knot_basis(k, tuple(np.clip(fraction, 0.0, 1.0)))
        variance = np.einsum("ni,ij,nj->n", basis, self.covariance[:k, :k], basis)
        return np.asarray(np.sqrt(variance))

    @cached_property
    def root(self) -> FloatArray:
        """(p, p) R with R Rᵀ = covariance, columns in order of falling size."""
        return np.ascontiguousarray(covariance_root(self.covariance)[:, ::-1])

    def models(self, deviates: FloatArray) -> list[CableModel]:
        """Models at standard normal deviates (lanes, p) of the parameters' distribution."""
        return [self.space.model(q) for q in self._at(np.atleast_2d(deviates))]

    def _at(self, deviates: FloatArray) -> FloatArray:
        """(lanes, p) coordinates at standard normal deviates (lanes, p), within bounds."""
        q = self.mean + deviates @ self.root.T
        return np.asarray(np.clip(q, self.space.low, self.space.high))

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; `from_dict` reads it back."""
        low, high = self.interval()
        pull = self.space.pull_m_per_s2
        return {
            "format": FORMAT,
            "method": self.method,
            "cable": self.space.cable.to_dict(),
            "gravity_m_per_s2": list(self.space.gravity_m_per_s2),
            "knots": self.space.knots,
            "effects": [effect.name for effect in self.space.effects],
            "exact": dict(self.space.exact),
            **self._effect_files(),
            "parameters": [
                {"name": n, "unit": u, "value": float(v), "low": float(lo), "high": float(hi)}
                for n, u, v, lo, hi in zip(
                    self.space.names, self.space.units, self.values, low, high, strict=True
                )
            ],
            "covariance": self.covariance.tolist(),
            "hand_covariance": self.gripper_covariance.tolist(),
            "noise": dict(vars(self.noise)),
            "residual_rms_m": self.residual_rms_m,
            "model_error_m": self.model_error_m,
            "converged": self.converged,
            "inflation": self.inflation,
            "frames_used": self.frames_used,
            "frames_total": self.frames_total,
            "passes": self.iterations,
            **({} if pull is None else {"pull_m_per_s2": pull}),
            **({"lacks": list(self.lacks)} if self.lacks else {}),
        }

    def _effect_files(self) -> dict[str, dict[str, dict[str, str | bool]]]:
        """Files of a user's own effects; empty if there are none."""
        own = {e.name: e.file for e in self.space.effects if e.file is not None}
        files: dict[str, dict[str, str | bool]] = {
            n: {"path": str(f.path), "sha256": f.sha256} for n, f in own.items()
        }
        for name in (n for n, f in own.items() if f.confined):
            files[name]["confined"] = True
        return {"effect_files": files} if files else {}

    @classmethod
    def from_dict(
        cls, data: Mapping[str, Any], effects: Mapping[str, type[Effect]] | None = None
    ) -> Identified:
        """Read what `to_dict` wrote.

        effects  those of the model by name, needed if it has any
        raises   ValueError: another format, a missing entry, an unknown effect, wrong shapes
        """
        if data.get("format") != FORMAT:
            raise ValueError(f"model format is {data.get('format')!r}, must be {FORMAT!r}")
        try:
            known = effects or {}
            unknown = [name for name in data["effects"] if name not in known]
            if unknown:
                raise ValueError(f"model has unknown effects {unknown}; known: {sorted(known)}")
            gx, gy = data["gravity_m_per_s2"]
            space = ParameterSpace.of(
                Cable.from_dict(data["cable"]),
                gravity_m_per_s2=(float(gx), float(gy)),
                effects=[known[name] for name in data["effects"]],
                prior=Prior(knots=int(data["knots"])),
                exact=data.get("exact"),
                pull_m_per_s2=data.get("pull_m_per_s2"),
            )
            names = tuple(p["name"] for p in data["parameters"])
            values = np.array([p["value"] for p in data["parameters"]], dtype=np.float64)
            covariance = np.array(data["covariance"], dtype=np.float64)
            if names != space.names or covariance.shape != (len(names), len(names)):
                raise ValueError(f"model's parameters are {names}, expected {space.names}")
            return cls(
                space,
                space.coordinates(values),
                covariance,
                Noise(**data["noise"]),
                float(data["residual_rms_m"]),
                float(data["inflation"]),
                int(data["frames_used"]),
                int(data["frames_total"]),
                int(data["passes"]),
                data["method"],
                np.array(data["hand_covariance"], dtype=np.float64),
                float(data.get("model_error_m", 0.0)),
                bool(data.get("converged", True)),
                tuple(map(str, data.get("lacks", ()))),
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"model: missing or mistyped entry {error}") from error
