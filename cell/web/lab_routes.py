"""Routes of the lab's page: uploads in, pages that commands wrote out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response

from cell.plant.users import Role
from cell.web.lab_tasks import PAGES, PREVIEW, LabTasks, Subject
from cell.web.visit import PagesContext, Visit
from cell.web.workspace import MOST_FILES, UploadError, UploadResult, is_name

#: Pages of commands have scripts of their own; they may do nothing with this server's.
_SANDBOX = {
    "content-security-policy": "sandbox allow-scripts; default-src 'unsafe-inline' data:; "
    "frame-ancestors 'self'",
    "cache-control": "no-store",
}


def lab_routes(app: FastAPI, room: PagesContext) -> None:
    """Add them to the application."""

    @app.post("/lab/upload")
    async def upload(request: Request) -> Response:
        visit = Visit(room, request.state.session, "", "en", str)
        if not visit.has_role(Role.engineer):  # before anything of it is read
            return JSONResponse({"error": visit.do("lab upload", Role.engineer, str)}, 403)
        async with request.form(max_files=MOST_FILES, max_fields=1) as form:
            given = [f for f in form.getlist("files") if isinstance(f, UploadFile)]
            files = [(f.filename or "", f.file) for f in given]
            return await run_in_threadpool(_take, visit, files)

    @app.get("/lab/results/{name}/{page}")
    def result(request: Request, name: str, page: str) -> Response:
        return _page(request, room, name, page)


def _take(visit: Visit, files: Sequence[tuple[str, IO[bytes]]]) -> Response:
    """Keep an upload, and have a study looked at."""
    lab = visit.room.lab
    taken: list[UploadResult] = []

    def act() -> str:
        try:
            lab.tidy()
            taken.append(lab.workspace.take(files))
        except (UploadError, OSError) as error:
            return str(error)
        return ""

    note = ", ".join(ascii(name[:80]) for name, _ in files[:5])
    if refused := visit.do("lab upload", Role.engineer, act, note):
        return JSONResponse({"error": refused}, 422)
    (found,) = taken
    if found.is_study:
        subject = Subject(found.name, lab.workspace.studies / found.name)
        lab.jobs.submit(LabTasks(lab.workspace, visit.room.config).show_study(subject), visit.name)
    answer = {"name": found.name, "is_study": found.is_study, "files": list(found.files)}
    return JSONResponse(answer)


def _page(request: Request, room: PagesContext, name: str, page: str) -> Response:
    if not Visit(room, request.state.session, "", "en", str).has_role(Role.engineer):
        return Response(status_code=403)
    workspace = room.lab.workspace
    path: Path | None = None
    if is_name(name) and page in PAGES:
        path = workspace.results(name) / page
    elif is_name(name) and page == PREVIEW:
        path = workspace.studies / name / page
    if path is None or not path.is_file() or not workspace.inside(path):
        return Response(status_code=404)
    return FileResponse(path, media_type="text/html", headers=_SANDBOX)
