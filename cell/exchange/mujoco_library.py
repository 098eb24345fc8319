"""MuJoCo, loaded when it is needed: an extra that not everybody has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class NoMujocoError(ValueError):
    """MuJoCo is not installed.  Scenario: `pip install cable-cell` without the extra `mujoco`."""


def mujoco_library() -> Any:
    """The module `mujoco`, whose springs may be polynomials.

    raises  NoMujocoError: it is not installed, or too old
    """
    try:
        import mujoco
    except ImportError as error:
        raise NoMujocoError(
            "MuJoCo is needed for this: pip install 'cable-cell[mujoco]'"
        ) from error
    if not hasattr(mujoco.MjModel, "jnt_stiffnesspoly"):
        raise NoMujocoError(
            f"MuJoCo {mujoco.__version__} has no polynomial springs; a newer one is needed: "
            "pip install -U 'cable-cell[mujoco]'"
        )
    return mujoco


@contextmanager
def without_log() -> Iterator[None]:
    """MuJoCo's warnings are not written to MUJOCO_LOG.TXT in the folder where one works."""
    mujoco = mujoco_library()
    former = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(former)
