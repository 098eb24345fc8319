"""A held cable simulated in portions, as the gripper's poses become known."""

from __future__ import annotations

import numpy as np

from cell.cable import camera
from cell.cable import layout as at
from cell.cable.arrays import FloatArray
from cell.cable.assembly import assemble, marker_weights
from cell.cable.effects.base import Effect
from cell.cable.effects.own import run_engine
from cell.cable.geometry import Motion, SmoothedMotion
from cell.cable.gripper_motions import GripperMotions
from cell.cable.model import CableModel
from cell.cable.solver import DivergedError, Solver, generalised_alpha
from cell.cable.splines import Steps, fit
from cell.cable.statics import settle
from cell.cable.stepping import integrate, nodes, sample_times

#: Poses that must follow before the gripper's acceleration at a pose is known: each new one changes
#: a spline's second derivative by 0.27 times what the one after it did.
_LATER = 6
#: Poses stored; far more than affect a spline's end.
_KEPT = 64
#: The motion's number for each of the lanes, of which all are the same cable.
_ALL_LANES = (0,) * at.LANES


def shown_live(effect: type[Effect]) -> bool:
    """Whether an effect depends on the current pose only, not on poses at other times."""
    return effect.camera_time is None and effect.clamp is None


class SwingingCable:
    """A simulated cable that starts in equilibrium at the first pose and keeps its state.

    The motion is final up to a few poses before the last; the rest is recomputed when later poses
    are known, so that the result does not depend on the portions.

    arc_length_m  (markers,) from the gripping point
    raises        ValueError: an effect of the model needs more than the present
    """

    def __init__(
        self, model: CableModel, arc_length_m: FloatArray, solver: Solver | None = None
    ) -> None:
        for active in model.effects:
            if not shown_live(active.effect):
                raise ValueError(
                    f"{active.effect.name} needs the gripper's or the cable's motion at other "
                    "times, "
                    "which is not known live; leave it out"
                )
        self._model = model
        self._solver = solver if solver is not None else Solver()
        (self._block,) = assemble([model], self._solver.segments, 0.0)
        self._markers = marker_weights([model], arc_length_m, self._solver.segments)
        self._poses = np.empty((0, 4))
        self._final_s = 0.0

    def advance(self, t_s: FloatArray, poses: FloatArray) -> FloatArray:
        """Swing on to the last of new poses.

        t_s      (T,) increasing, after all others
        poses    (T, 3) x, y, angle of the gripping point: m, m, rad
        returns  (T, markers, 2) x, y at these times, m
        raises   DivergedError
        """
        new = np.column_stack([t_s, poses])
        if len(self._poses) == 0:
            self._settle(new[0])
        self._poses = np.concatenate([self._poses, new])
        motion = self._motion()
        begun_s, final_s = self._final_s, max(float(self._poses[-1 - _LATER, 0]), self._final_s)
        early = t_s <= final_s
        bends = np.concatenate(
            [
                self._swing(motion, begun_s, final_s, t_s[early], self._block.state, keep=True),
                self._swing(
                    motion, final_s, float(t_s[-1]), t_s[~early], self._block.state, keep=False
                ),
            ]
        )
        self._final_s = final_s
        self._poses = self._poses[-_KEPT:]
        return self._positions(motion, np.asarray(t_s, dtype=np.float64), bends)

    def _settle(self, first: FloatArray) -> None:
        """Rest at the first pose, and have rested there for a while."""
        row = np.zeros((1, at.BASE_FIELDS, at.LANES))
        row[0, :3] = first[1:, None]
        settle(self._block, row.ravel())
        self._final_s = float(first[0])
        before = np.tile(first, (_LATER, 1))
        before[:, 0] -= self._solver.step_s * np.arange(_LATER, 0, -1)
        self._poses = before

    def _motion(self) -> Motion:
        """The poses, and one more at the speed of the last, where the spline ends.

        A gripper that gains speed is elsewhere by then: that one is no wrong sample of a log.
        """
        last, before = self._poses[-1], self._poses[-2]
        t_s, *pose = np.concatenate([self._poses, [2.0 * last - before]]).T
        x, y, angle = (fit(t_s, values, checked=True) for values in pose)
        return SmoothedMotion(t_s, *pose, smoothed=(x, y, angle))

    def _swing(
        self,
        motion: Motion,
        begin_s: float,
        end_s: float,
        times_s: FloatArray,
        state: FloatArray,
        keep: bool,
    ) -> FloatArray:
        """(times, segments + 1, LANES) bends; the block's state is advanced only with `keep`."""
        block, solver = self._block, self._solver
        bends = np.empty((len(times_s), block.segments + 1, at.LANES))
        steps = int(np.ceil((end_s - begin_s) / solver.step_s - 1e-9))
        rested = times_s <= begin_s
        bends[rested] = state.reshape(block.segments + 1, at.FIELDS, at.LANES)[:, at.BEND]
        if steps < 1:
            return bends
        step_s = (end_s - begin_s) / steps
        *effects, memory, memory_rows, _ = block.effects
        if not keep:
            state, memory = state.copy(), memory.copy()
        coefficients = generalised_alpha(step_s, solver.damping)
        in_steps = Steps(begin_s, step_s, steps, float(coefficients[12]))
        base = GripperMotions([motion], [self._model]).at_steps(_ALL_LANES, in_steps)
        swung = np.empty((int(np.count_nonzero(~rested)), block.segments + 1, at.LANES))
        bad = run_engine(
            integrate,
            block.own,
            state,
            block.width,
            block.segments,
            base.ravel(),
            coefficients,
            block.nonlinear,
            block.iterations,
            (*effects, memory, memory_rows, begin_s),
            sample_times([np.minimum((times_s[~rested] - begin_s) / step_s, steps)] * block.width),
            swung.ravel(),
            np.empty(0),
        )
        if bad >= 0:
            raise DivergedError([0], begin_s + (bad + 1) * step_s, step_s)
        bends[~rested] = swung
        return bends

    def _positions(self, motion: Motion, t_s: FloatArray, bends: FloatArray) -> FloatArray:
        clamp = GripperMotions([motion], [self._model]).at_times(_ALL_LANES, [t_s] * at.LANES)
        out = np.empty((self._block.width, len(t_s), len(self._markers[0]), 2))
        nodes(
            bends.ravel(),
            self._block.width,
            self._block.segments,
            self._block.lengths,
            clamp.ravel(),
            *self._markers,
            out,
        )
        shown: FloatArray = camera.image_positions(self._model, t_s, t_s, out[0])
        return shown
