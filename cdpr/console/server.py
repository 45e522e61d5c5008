"""The console's web server: one page, its files, one socket a page. Nothing moves because of it."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from cdpr.console.commands import Held, LetGo, NotAMessage, parse_message
from cdpr.console.session import MADE, Console
from cdpr.console.view import scene_of
from executor.recording.run_course import RUNS
from executor.recording.verdict import fault_codes, page_text

#: States a second.
RATE = 20.0
#: A page that does not take its states for so long is let go, [s].
PATIENCE = 2.0
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css",
    ".js": "text/javascript",
    ".txt": "text/plain",
    ".md": "text/plain; charset=utf-8",
}


class ConsoleServer:
    """The pages that are open, and the state that they are sent.

    Attributes:
        token: Who knows it may look, and take control.
    """

    def __init__(self, console: Console, token: str | None = None) -> None:
        """No page is open; without a token one is drawn."""
        self.token = token or secrets.token_urlsafe(18)
        self._console = console
        self._state: dict[str, Any] = {}
        self._news = asyncio.Condition()
        self._seq = 0

    def app(self) -> Starlette:
        """The application for any ASGI server."""
        return Starlette(
            routes=[
                Route("/", self._page),
                Route("/static/{name:path}", _static),
                Route("/scene", self._scene),
                Route("/api/files", self._files),
                Route("/api/preview", self._preview),
                Route("/runs/{name:path}", _run_file),
                Route("/help/{code}", _help),
                Route("/stop", self._stop, methods=["POST"]),
                WebSocketRoute("/ws", self._socket),
            ],
            middleware=[Middleware(BaseHTTPMiddleware, dispatch=self._guarded)],
            lifespan=self._living,
        )

    @asynccontextmanager
    async def _living(self, _app: Starlette) -> AsyncIterator[None]:
        looking = asyncio.create_task(self._look())
        try:
            yield
        finally:
            looking.cancel()
            with suppress(asyncio.CancelledError):
                await looking
            await run_in_threadpool(self._console.close)

    async def _look(self) -> None:
        """The state of all, again and again; where looking fails, pages see old data and say so."""
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            self._state = await run_in_threadpool(self._console.look)
            async with self._news:
                self._seq += 1
                self._news.notify_all()
            await asyncio.sleep(max(0.005, began + 1.0 / RATE - loop.time()))

    # Who may.

    async def _guarded(self, request: Request, go_on: Any) -> Response:
        """No page of another origin gets or does anything; files that say nothing need no token."""
        path = request.url.path
        is_open = path.startswith("/static/") or path == "/stop"
        if not _same_origin(request.headers):
            return Response("another origin", 403)
        if not is_open and not self._knows(request.query_params.get("token")):
            text = "open the address that `cdpr console` printed: it has the token"
            return Response(text, 403)
        response: Response = await go_on(request)
        response.headers["Content-Security-Policy"] = _POLICY if path == "/" else "sandbox"
        if path.startswith("/runs/"):
            del response.headers["Content-Security-Policy"]  # reports bring their own
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cache-Control"] = "no-store"
        return response

    def _knows(self, token: str | None) -> bool:
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    # What there is.

    async def _page(self, _request: Request) -> Response:
        return HTMLResponse(_resource("index.html"))

    async def _scene(self, _request: Request) -> Response:
        data = await run_in_threadpool(scene_of, self._console.rig, self._console.scene)
        return JSONResponse(data)

    async def _files(self, _request: Request) -> Response:
        return JSONResponse(await run_in_threadpool(_plans_and_scenes))

    async def _preview(self, _request: Request) -> Response:
        if self._console.preview is None:
            raise HTTPException(404, "no plan is loaded")
        return JSONResponse(self._console.preview)

    async def _stop(self, _request: Request) -> Response:
        """For a page whose socket is lost; anybody may stop."""
        why_not = await run_in_threadpool(self._console.stop)
        return JSONResponse({"ok": not why_not, "what": why_not})

    # The socket.

    async def _socket(self, socket: WebSocket) -> None:
        known = self._knows(socket.query_params.get("token"))
        if not (known and "origin" in socket.headers and _same_origin(socket.headers)):
            await socket.close(4403)
            return
        await socket.accept()
        client = socket.client
        page = self._console.control.join("?" if client is None else f"{client.host}")
        telling = asyncio.create_task(self._tell(socket, page))
        try:
            while True:
                await self._hear(socket, page, await socket.receive_text())
        except (WebSocketDisconnect, RuntimeError, KeyError):
            pass
        finally:
            telling.cancel()
            await run_in_threadpool(self._console.leave, page)

    async def _tell(self, socket: WebSocket, page: int) -> None:
        seen = 0  # before the first look there is nothing to tell
        while True:
            async with self._news:
                while self._seq == seen:
                    await self._news.wait()
                seen = self._seq
            control = self._console.control
            own = {"yours": control.holder == page, "held_by": control.holder_name()}
            state = {**self._state, "seq": seen, "control": own}
            try:
                await asyncio.wait_for(socket.send_json(state), PATIENCE)
            except (TimeoutError, RuntimeError, WebSocketDisconnect):
                with suppress(RuntimeError):
                    await socket.close(1013)
                return

    async def _hear(self, socket: WebSocket, page: int, text: str) -> None:
        try:
            message = parse_message(text)
        except NotAMessage as error:
            await socket.send_json({"kind": "answer", "to": 0, "ok": False, "what": str(error)})
            return
        if isinstance(message, Held):
            await run_in_threadpool(self._console.held, page, message)
        elif isinstance(message, LetGo):
            await run_in_threadpool(self._console.let_go, page, message)
        else:
            why_not = await run_in_threadpool(self._console.command, page, message)
            answer = {"kind": "answer", "to": message.id, "ok": not why_not, "what": why_not}
            await socket.send_json(answer)


def _same_origin(headers: Any) -> bool:
    """A browser names the page that asks; programs name none."""
    origin = headers.get("origin")
    return origin is None or origin.partition("://")[2] == headers.get("host")


def _resource(name: str) -> str:
    return files("cdpr.console").joinpath("static", name).read_text(encoding="utf-8")


async def _static(request: Request) -> Response:
    """Files of the page, and those that it shares with reports."""
    name = request.path_params["name"]
    package = "model.pages" if name in ("base.css", "viewer.js") else "cdpr.console"
    root = files(package) if package == "model.pages" else files(package).joinpath("static")
    kind = _KINDS.get(Path(name).suffix)
    if kind is None or ".." in Path(name).parts or name.startswith("/"):
        raise HTTPException(404)
    try:
        return Response(root.joinpath(name).read_bytes(), media_type=kind)
    except (OSError, ValueError):
        raise HTTPException(404) from None


async def _run_file(request: Request) -> Response:
    """A file of a run below the folder of runs."""
    path, root = (RUNS / request.path_params["name"]).resolve(), RUNS.resolve()
    if not (path.is_relative_to(root) and path.is_file()):
        raise HTTPException(404)
    return FileResponse(path)


async def _help(request: Request) -> Response:
    """The page of help for an event or fault."""
    code = request.path_params["code"]
    if code not in fault_codes():
        raise HTTPException(404)
    return Response(page_text(code), media_type=_KINDS[".md"])


def _plans_and_scenes() -> dict[str, list[str]]:
    """Files that can be chosen, below the folder that the console runs in."""
    here = Path()
    plans = sorted({*here.glob("*.json"), *here.glob("plans/*.json"), *MADE.glob("*.plan.json")})
    folders = (here, here / "scenes", here / "configs")
    scenes = sorted({path for folder in folders for path in folder.glob("*.yaml")})
    return {
        "plans": [str(path) for path in plans if _says(path, '"kind": "cdpr-plan"')],
        "scenes": [str(path) for path in scenes if _says(path, "\ngoal:")],
    }


def _says(path: Path, word: str) -> bool:
    with suppress(OSError), path.open(encoding="utf-8", errors="replace") as stream:
        return word in stream.read(100_000)
    return False
