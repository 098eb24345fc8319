"""What a person has typed and not kept: the browser asks before it leaves the page."""

from __future__ import annotations

import json

from nicegui import ui

_SCRIPT = """
<script>
window.unsaved = new Set();
window.addEventListener('beforeunload', (e) => { if (unsaved.size) e.preventDefault(); });
</script>
"""


def begin() -> None:
    """Have the browser ask; once a page."""
    ui.add_body_html(_SCRIPT)


class Unsaved:
    """Whether something of this name would be lost with the page."""

    def __init__(self, name: str) -> None:
        self._name, self._is_typed = name, False

    def set(self, is_typed: bool) -> None:
        """Tell the browser, if that has changed."""
        if is_typed != self._is_typed:
            self._is_typed = is_typed
            change = "add" if is_typed else "delete"
            ui.run_javascript(f"unsaved.{change}({json.dumps(self._name)})")
