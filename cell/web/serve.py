"""The web server of the pages: routes, login, and the frame around every page."""

from __future__ import annotations

import logging
import re
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI
from jinja2 import Environment, FileSystemLoader
from nicegui import ui
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    RedirectResponse,
    Response,
)
from starlette.staticfiles import StaticFiles

from calib.store import KINDS
from cell.calibration import assistants
from cell.files.input_error import InputError
from cell.plant.users import Role, Users
from cell.settings import load_settings
from cell.web import cycle_view, heartbeat, lab_tasks
from cell.web.guard import COOKIE, LOGIN, METRICS, SANDBOX, Guard, TimedHttp
from cell.web.metrics import CellMetrics
from cell.web.pages import calibration, history, lab, live, settings
from cell.web.pages.cycle import build as build_cycle
from cell.web.theme import MANUAL, N_, UNSAVED, asset, manual_page
from cell.web.visit import PagesContext, Visit
from cell.web.wording import languages, preferred, translation
from cell.web.workspace import MOST_FILES, UploadError, UploadResult, is_name


@dataclass(frozen=True)
class Page:
    """A page of the menu.

    title  in English, marked for the catalogues
    role   least role that may open it
    build  fills the page
    """

    path: str
    title: str
    icon: str
    role: Role
    build: Callable[[Visit], None]


PAGES: tuple[Page, ...] = (
    Page("/", N_("Live"), "precision_manufacturing", Role.watch, live.build),
    Page("/history", N_("History"), "history", Role.watch, history.build),
    Page("/lab", N_("Lab"), "science", Role.engineer, lab.build),
    Page("/calibration", N_("Calibration"), "straighten", Role.engineer, calibration.build),
    Page("/settings", N_("Settings"), "tune", Role.engineer, settings.build),
)


_LOG = logging.getLogger(__name__)

_TITLE = "Cable cell"
_THEMES: dict[str, bool | None] = {"auto": None, "dark": True, "light": False}
_YEAR_S = 365 * 86400
#: Time for which a browser caches a frame of a film, s.
_FRAME_S = 600


def serve(
    room: PagesContext,
    users: Users,
    address: tuple[str, int],
    tls: tuple[Path, Path] | None,
    token: str = "",
) -> None:
    """Serve the pages until Ctrl-C or SIGTERM.

    tls     certificate and its key; None = without, on loopback only
    token   of the metrics; empty = they need a login, too
    raises  OSError: the address is taken
    """
    pages = application(room, users, tls is not None)
    app = Guard(pages, room.sessions, tls is not None, users, token)
    files = () if tls is None else zip(("ssl_certfile", "ssl_keyfile"), map(str, tls), strict=True)
    options: dict[str, Any] = dict(files)
    # uvicorn raises the signal again after it has closed: the open resources here must be closed
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with room.watch, room.lab.jobs:
        uvicorn.run(
            app,
            host=address[0],
            port=address[1],
            log_level="warning",
            server_header=False,
            proxy_headers=False,  # clients can forge `X-Forwarded-For`
            http=TimedHttp,
            ws_max_size=1 << 20,
            timeout_graceful_shutdown=2,
            **options,
        )
    room.guided.close()
    room.client.close()


def application(room: PagesContext, users: Users, secure: bool) -> FastAPI:
    """The web application, without `Guard` around it."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    _login_routes(app, room, users, secure)
    _cycle_routes(app, room)
    _calibration_routes(app, room)
    lab_routes(app, room)
    _metrics_route(app, room)
    if manual_page("index.html"):
        app.mount("/manual", StaticFiles(directory=MANUAL, html=True))
    for page in PAGES:
        _page_route(room, page)

    @ui.page("/cycle/{name}", title=_TITLE, dark=None)
    def cycle(request: Request, name: str) -> None:
        if cycle_view.cycle_folder(room.runs, name) is None:
            ui.context.client.status_code = 404
            ui.label("no such cycle")
            return
        visit = _visit(room, request)
        _framed(visit, request)
        build_cycle(visit, name)

    ui.run_with(app, title=_TITLE, dark=None, show_welcome_message=False, reconnect_timeout=10.0)
    return app


def _page_route(room: PagesContext, page: Page) -> None:
    @ui.page(page.path, title=_TITLE, dark=None)
    def built(request: Request) -> None:
        visit = _visit(room, request)
        _framed(visit, request)
        with ui.column().classes("page w-full max-w-7xl mx-auto p-2 gap-4"):
            if visit.has_role(page.role):
                page.build(visit)
            else:
                ui.context.client.status_code = 403
                ui.label(visit.t("You may not see this page."))


def _visit(room: PagesContext, request: Request) -> Visit:
    language = _language(request)
    page = ui.context.client.id
    return Visit(room, request.state.session, page, language, translation(language))


def _language(request: Request) -> str:
    chosen = request.cookies.get("language", "")
    accepted = request.headers.get("accept-language", "")
    return chosen if chosen in languages() else preferred(accepted)


def _framed(visit: Visit, request: Request) -> None:
    """Head line with the menu, language, theme and logout."""
    t = visit.t
    ui.add_css(asset("theme.css"))
    ui.dark_mode(_THEMES.get(request.cookies.get("theme", "")))
    ui.add_head_html(f"<script>document.documentElement.lang = {visit.language!r}</script>")
    with ui.header().classes("items-center gap-1 px-2 py-1 bg-slate-800 flex-wrap"):
        for page in PAGES:
            if visit.session.user.role >= page.role:
                link = ui.link(t(page.title), page.path)
                link.classes("text-white no-underline text-lg px-3 py-2 rounded")
                if request.url.path == page.path:
                    link.classes("bg-slate-600").props("aria-current=page")
        ui.space()
        theme = {"auto": "dark", "dark": "light"}.get(request.cookies.get("theme", "auto"), "auto")
        words = {"auto": N_("Automatic"), "dark": N_("Dark"), "light": N_("Light")}
        small = "text-white px-2 py-2 text-sm no-underline"
        if manual := manual_page("index.html"):
            ui.link(t(N_("Manual")), manual, new_tab=True).classes(small)
        for name in languages():
            if name != visit.language:
                ui.link(name.upper(), f"/choose?language={name}").classes(small)
        ui.link(t(words[theme]), f"/choose?theme={theme}").classes(small)
        if visit.room.sessions is not None:
            ui.link(f"{t('Log out')} {visit.name}", "/logout").classes(small)
    heartbeat.begin(visit.heartbeats, t)
    ui.add_body_html(UNSAVED)


def _login_routes(app: FastAPI, room: PagesContext, users: Users, secure: bool) -> None:
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True
    )

    def shown(request: Request, wrong: str = "", status: int = 200) -> Response:
        language = _language(request)
        t = translation(language)
        words = {"name": t("Name"), "password": t("Password"), "enter": t("Log in")}
        page = templates.get_template("login.html")
        html = page.render(language=language, title=_TITLE, wrong=t(wrong), **words)
        return HTMLResponse(html, status)

    @app.get(LOGIN)
    def login(request: Request) -> Response:
        return shown(request) if room.sessions is not None else RedirectResponse("/")

    @app.post(LOGIN)
    async def enter(request: Request) -> Response:
        if room.sessions is None:
            return RedirectResponse("/", 303)
        async with request.form(max_files=0, max_fields=4, max_part_size=4096) as form:
            name, password = str(form.get("name", "")), str(form.get("password", ""))
        by, address = name[:60], request.client.host if request.client else ""
        limit = room.sessions.count_login(by, address)
        if limit is not None:
            if limit.is_first:  # a line each would fill the disk
                note = f"from {address}; too many wrong passwords {limit.counted}"
                room.audit.write(by, "log in", False, note)
            return shown(request, N_("Too many wrong passwords; wait a minute."), 429)
        user = await run_in_threadpool(users.authenticate, name, password)
        room.audit.write(by, "log in", user is not None, f"from {address}")
        if user is None:
            return shown(request, N_("Name or password is wrong."), 401)
        room.sessions.count_right(by, address)
        answer = RedirectResponse("/", 303)
        token = room.sessions.begin(user)
        answer.set_cookie(COOKIE, token, httponly=True, secure=secure, samesite="strict")
        return answer

    @app.get("/logout")
    def logout(request: Request) -> Response:
        if room.sessions is not None:
            room.sessions.end(request.cookies.get(COOKIE))
            room.audit.write(request.state.session.user.name, "log out", True)
        answer = RedirectResponse(LOGIN, 303)
        answer.delete_cookie(COOKIE)
        return answer

    @app.get("/choose")
    def choose(request: Request, language: str = "", theme: str = "") -> Response:
        answer = RedirectResponse(_came_from(request), 303)
        if language in languages():
            answer.set_cookie("language", language, _YEAR_S, samesite="lax")
        if theme in _THEMES:
            answer.set_cookie("theme", theme, _YEAR_S, samesite="lax")
        return answer


def _came_from(request: Request) -> str:
    """Path of the referring page of this server; "/" if unknown."""
    came = urlsplit(request.headers.get("referer", ""))
    if came.netloc != request.headers.get("host") or not re.match(r"/[\w-]", came.path):
        return "/"
    return came.path + (f"?{came.query}" if came.query else "")


def _cycle_routes(app: FastAPI, room: PagesContext) -> None:
    def file_of(name: str, find: Callable[[Path], Path | None]) -> Response:
        folder = cycle_view.cycle_folder(room.runs, name)
        path = None if folder is None else find(folder)
        return Response(status_code=404) if path is None else FileResponse(path)

    @app.get("/cycles/{name}/newest")
    def newest(name: str) -> Response:
        return file_of(name, cycle_view.newest_picture)

    @app.get("/cycles/{name}/pictures/{picture}")
    def one(name: str, picture: str) -> Response:
        return file_of(name, lambda folder: cycle_view.picture(folder, picture))

    @app.get("/live/{number}.jpg")
    def live(number: int) -> Response:
        newest = room.camera.newest
        if newest is None:
            return Response(status_code=404)
        headers = {"cache-control": "no-store"}
        return Response(newest.jpeg, media_type="image/jpeg", headers=headers)

    @app.get("/cycles/{name}/frames/{number}.jpg")
    def frame(name: str, number: int) -> Response:
        folder = cycle_view.cycle_folder(room.runs, name)
        try:
            if folder is None:
                raise IndexError(name)
            picture = room.films.frame(folder, number)
        except (OSError, IndexError, InputError):
            return Response(status_code=404)
        headers = {"cache-control": f"private, max-age={_FRAME_S}"}
        return Response(picture, media_type="image/jpeg", headers=headers)

    @app.get("/cycles/{name}/report")
    def report(name: str) -> Response:
        folder = cycle_view.cycle_folder(room.runs, name)
        if folder is None:
            return Response(status_code=404)
        with suppress(OSError):
            try:
                return HTMLResponse(cycle_view.report(folder), headers=SANDBOX)
            except InputError as error:
                return Response(str(error), 422, media_type="text/plain")
        return Response("cannot be read", 422, media_type="text/plain")


def _metrics_route(app: FastAPI, room: PagesContext) -> None:
    metrics = CellMetrics(room.watch)

    @app.get(METRICS)
    def exposition(request: Request) -> Response:
        body, content_type = metrics.exposition(request.headers.get("accept", ""))
        return Response(body, headers={"content-type": content_type, "cache-control": "no-store"})


def _calibration_routes(app: FastAPI, room: PagesContext) -> None:
    """Reports and the picture of the coverage, for engineers."""

    @app.get("/calibration/{name}")
    def shown(request: Request, name: str) -> Response:
        if request.state.session.user.role < Role.engineer:
            return Response(status_code=403)
        settings = load_settings(room.config)
        section = settings.calibration
        if section is None:
            return Response(status_code=404)
        reports = {*KINDS, *(f"grip.{product}" for product in settings.products)}
        if name == assistants.FILE and (section.folder / name).is_file():
            headers = {"cache-control": "no-store"}
            return FileResponse(section.folder / name, headers=headers)
        if name in reports and (section.folder / f"{name}.html").is_file():
            return FileResponse(section.folder / f"{name}.html", headers=SANDBOX)
        return Response(status_code=404)


def may_be_served(host: str, tls: bool, users: int, loopback: bool) -> str:
    """Why pages may not be served at an address, or ""."""
    if loopback:
        return ""
    if not tls:
        return f"--host {host}: beyond loopback TLS is needed: give --certificate and --key"
    if not users:
        return f"--host {host}: beyond loopback users are needed: cell user add NAME"
    return ""


def lab_routes(app: FastAPI, room: PagesContext) -> None:
    """Uploads of the lab's page, and pages that its commands wrote."""

    @app.post("/lab/upload")
    async def upload(request: Request) -> Response:
        visit = Visit(room, request.state.session, "", "en", str)
        if not visit.has_role(Role.engineer):  # before anything of it is read
            return JSONResponse({"error": visit.do("lab upload", Role.engineer, str)}, 403)
        async with request.form(max_files=MOST_FILES, max_fields=1) as form:
            uploads = [f for f in form.getlist("files") if isinstance(f, UploadFile)]
            files = [(f.filename or "", f.file) for f in uploads]
            return await run_in_threadpool(_take, visit, files)

    @app.get("/lab/results/{name}/{page}")
    def result(request: Request, name: str, page: str) -> Response:
        if not Visit(room, request.state.session, "", "en", str).has_role(Role.engineer):
            return Response(status_code=403)
        workspace = room.lab.workspace
        if not is_name(name) or page not in lab_tasks.PAGES:
            return Response(status_code=404)
        path = lab_tasks.page_file(workspace, name, page)
        if not path.is_file() or not workspace.inside(path):
            return Response(status_code=404)
        headers = {**SANDBOX, "cache-control": "no-store"}
        return FileResponse(path, media_type="text/html", headers=headers)


def _take(visit: Visit, files: Sequence[tuple[str, IO[bytes]]]) -> Response:
    """Store an upload, and start the overview of a study."""
    lab = visit.room.lab
    results: list[UploadResult] = []

    def act() -> str:
        try:
            lab.tidy()
            results.append(lab.workspace.take(files))
        except (UploadError, OSError) as error:
            return str(error)
        return ""

    note = ", ".join(ascii(name[:80]) for name, _ in files[:5])
    if refused := visit.do("lab upload", Role.engineer, act, note):
        return JSONResponse({"error": refused}, 422)
    (result,) = results
    if result.is_study:
        subject = lab_tasks.Subject(result.name, lab.workspace.studies / result.name)
        lab.jobs.submit(
            lab_tasks.LabTasks(lab.workspace, visit.room.config).show_study(subject), visit.name
        )
    answer = {"name": result.name, "is_study": result.is_study, "files": list(result.files)}
    return JSONResponse(answer)
