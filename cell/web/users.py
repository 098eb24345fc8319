"""Users of the pages: those of all programs beside the cell."""

from __future__ import annotations

from cell.plant.users import LEAST_PASSWORD, MOST_PASSWORD, Role, User, Users

__all__ = ["LEAST_PASSWORD", "MOST_PASSWORD", "Role", "User", "Users"]
