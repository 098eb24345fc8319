"""A place to drop files or a folder on; they go to the lab in one request."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui

from cell.web.guard import MOST_BYTES
from cell.web.pages.lab.desk import Desk
from cell.web.theme import N_

_SCRIPT = """
(() => {
  const zone = document.querySelector('[data-test=drop]');
  if (!zone || zone.dataset.ready) return;
  zone.dataset.ready = 'yes';
  const say = text => { zone.querySelector('.drop-said').textContent = text; };
  const send = files => {
    const total = files.reduce((sum, f) => sum + f.file.size, 0);
    if (!files.length) return;
    if (total > MOST) { say(TOO_LARGE); return; }
    const form = new FormData();
    for (const {file, name} of files) form.append('files', file, name);
    const request = new XMLHttpRequest();
    request.open('POST', '/lab/upload');
    request.upload.onprogress = e => say(Math.round(100 * e.loaded / e.total) + ' %');
    request.onerror = () => say(BROKEN);
    request.onload = () => {
      let answer = {error: request.status + ' ' + request.statusText};
      try { answer = JSON.parse(request.responseText); } catch {}
      say('');
      emitEvent('lab_uploaded', answer);
    };
    request.send(form);
  };
  const walk = async (entry, into) => {
    if (entry.isFile) {
      const file = await new Promise((good, bad) => entry.file(good, bad));
      into.push({file, name: entry.fullPath.replace(/^\\//, '')});
    } else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((good, bad) => reader.readEntries(good, bad));
        if (!some.length) break;
        for (const one of some) await walk(one, into);
      }
    }
  };
  zone.ondragover = e => { e.preventDefault(); zone.classList.add('drop-over'); };
  zone.ondragleave = () => zone.classList.remove('drop-over');
  zone.ondrop = async e => {
    e.preventDefault();
    zone.classList.remove('drop-over');
    const entries = [...e.dataTransfer.items].map(i => i.webkitGetAsEntry()).filter(Boolean);
    const found = [];
    for (const entry of entries) await walk(entry, found);
    send(found);
  };
  for (const input of zone.querySelectorAll('input')) {
    input.onchange = () => {
      send([...input.files].map(f => ({file: f, name: f.webkitRelativePath || f.name})));
      input.value = '';
    };
  }
})();
"""
_CSS = """
.drop-zone { border: 2px dashed #8a94a3; border-radius: 8px; padding: 1.2rem; }
.drop-over { border-color: #0b7fab; background: #0b7fab22; }
.drop-zone label { cursor: pointer; text-decoration: underline; padding: 0.5rem; }
.drop-zone input { position: absolute; width: 1px; height: 1px; opacity: 0; }
.drop-zone label:focus-within { outline: 3px solid #f5b301; }
"""


def drop_zone(desk: Desk, uploaded: Callable[[dict[str, Any]], Awaitable[None]]) -> None:
    """Make it; `uploaded` gets what the server answered to an upload that was taken."""
    t = desk.t
    ui.add_css(_CSS)
    with ui.element("div").classes("drop-zone w-full").props("data-test=drop"):
        ui.label(t("Drop a study's folder, a .zip of it, or tables (CSV, TRC, C3D) here."))
        with ui.row().classes("gap-2"):
            for name, words, options in (
                ("files", N_("Choose files"), "multiple"),
                ("folder", N_("Choose a folder"), "webkitdirectory"),
            ):
                with ui.element("label"):
                    ui.label(t(words)).classes("inline")
                    ui.element("input").props(f"type=file {options} data-test=upload-{name}")
        ui.label(f"{t('At most')} {MOST_BYTES >> 20} MiB").classes("text-sm opacity-70")
        ui.label().classes("drop-said font-bold")

    async def heard(event: Any) -> None:
        answer = event.args if isinstance(event.args, dict) else {}
        if "error" in answer:
            desk.told(str(answer["error"]))
        elif isinstance(answer.get("name"), str):
            await uploaded(answer)

    ui.on("lab_uploaded", heard)
    script = _SCRIPT.replace("MOST", str(MOST_BYTES - 65536))
    script = script.replace("TOO_LARGE", json.dumps(t("Too large: upload less at once.")))
    script = script.replace("BROKEN", json.dumps(t("The connection broke: try again.")))
    ui.timer(0.1, lambda: ui.run_javascript(script), once=True)
