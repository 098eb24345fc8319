"""Settings → the types of the rooms below."""

from __future__ import annotations

from calib.plane import PlaneView
from cell.cable.geometry import Cable
from cell.settings import model as given
from cell.settings.model import Settings
from drivers.interfaces import Pose


def cable_of(settings: Settings) -> Cable:
    """Data sheet of the cable."""
    return Cable(**settings.cable.model_dump())


def pose_of(pose: given.Pose) -> Pose:
    """Pose of the gripping point in the cell's plane."""
    return Pose(pose.x_m, pose.y_m, pose.angle_rad)


def view_of(view: given.View) -> PlaneView:
    """The map between pixels and the cell's plane."""
    return PlaneView.from_scale(view.metres_per_pixel, view.origin_column_px, view.origin_row_px)
