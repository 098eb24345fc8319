"""Settings of a cell: one YAML file, every mistake in it named before anything moves."""

from cell.files.input_error import InputError
from cell.settings.loading import load_settings
from cell.settings.model import Settings

__all__ = ["InputError", "Settings", "load_settings"]
