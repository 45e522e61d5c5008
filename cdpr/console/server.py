"""The console's web server: the page, its files, and one WebSocket per page."""

from __future__ import annotations

import asyncio
import errno
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse

from cdpr.console.commands import (
    Held,
    Inbox,
    LetGo,
    Message,
    NotAMessage,
    Seen,
    parse_message,
)
from cdpr.console.session import Console
from cdpr.console.state import StateFlow, StateTimes, plans_and_scenes
from cdpr.console.view import scene_of
from executor.realtime.scheduling import prompt_threads, take_short_turns
from executor.recording.record_files import RUNS
from executor.safety.fault_messages import fault_codes, page_text
from model.errors import BadInput

#: States per second.
RATE = 20.0
#: A page to which a state cannot be sent within this time is disconnected, [s].
PATIENCE = 2.0
#: So is one that acknowledges none within this time, [s].
UNSEEN = 10.0
#: Largest number of open pages; STOP by `POST /stop` works without one.
MOST_PAGES = 64
#: A page whose newest state was followed by another this long ago cannot jog, [s].
BEHIND = 0.3
STOPS_AT_ONCE = 4
PRESSES_AT_ONCE = 4
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


T = TypeVar("T")


class ConsoleServer:
    """The open pages, and the state sent to them.

    Attributes:
        token: Grants access to the page, and control.
    """

    def __init__(self, console: Console, token: str | None = None, host: str = "") -> None:
        """Starts with no page open.

        Args:
            console: The console to serve.
            token: Of the address (default: random).
            host: Another name of this machine that requests may use.
        """
        self.token = token or secrets.token_urlsafe(18)
        self._names = {"localhost", socket.gethostname().lower(), host.lower()}
        self._pages = 0
        self._console = console
        self._state: dict[str, Any] = {}
        self._news = asyncio.Condition()
        self._times = StateTimes(round(2.0 * RATE))
        self._stops = ThreadPoolExecutor(STOPS_AT_ONCE, "cdpr-stop")
        self._presses = ThreadPoolExecutor(PRESSES_AT_ONCE, "cdpr-press")
        self._stopping: set[asyncio.Task[None]] = set()

    def app(self) -> FastAPI:
        """The application for any ASGI server."""
        app = FastAPI(lifespan=self._living, openapi_url=None)
        app.middleware("http")(self._guarded)
        for path, resource in (
            ("/", self._page),
            ("/static/{name:path}", _static),
            ("/scene", self._scene),
            ("/api/files", self._files),
            ("/api/preview", self._preview),
            ("/api/compared", self._compared),
            ("/camera/{name}", self._picture),
            ("/runs/{name:path}", _run_file),
            ("/help/{code}", _help),
        ):
            app.get(path, response_model=None)(resource)
        app.post("/stop")(self._stop)
        app.websocket("/ws")(self._socket)
        return app

    @asynccontextmanager
    async def _living(self, _app: FastAPI) -> AsyncIterator[None]:
        updates = asyncio.create_task(self._update_states())
        try:
            yield
        finally:
            updates.cancel()
            with suppress(asyncio.CancelledError):
                await updates
            self._stops.shutdown()
            self._presses.shutdown()
            await run_in_threadpool(self._console.close)

    async def _update_states(self) -> None:
        """Updates the state at `RATE`; if that fails, pages report stale data."""
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            with suppress(Exception):  # such as a removed file; it is tried again
                self._state = await run_in_threadpool(self._console.update)
                async with self._news:
                    self._times.add(loop.time())
                    self._news.notify_all()
            await asyncio.sleep(max(0.005, began + 1.0 / RATE - loop.time()))

    # Access.
    async def _guarded(self, request: Request, call_next: Any) -> Response:
        """Refuses other origins, and requests without a token except for static files and STOP."""
        path = request.url.path
        is_open = path.startswith("/static/") or path == "/stop"
        if not self._is_same_origin(request.headers):
            return Response("wrong origin, or not a name of this machine", 403)
        if not is_open and not self._knows(request.query_params.get("token")):
            text = "open the address printed by `cdpr console`: it contains the token"
            return Response(text, 403)
        response: Response = await call_next(request)
        response.headers["Content-Security-Policy"] = _POLICY if path == "/" else "sandbox"
        if path.startswith("/runs/"):
            del response.headers["Content-Security-Policy"]  # reports bring their own
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cache-Control"] = "no-store"
        return response

    def _is_same_origin(self, headers: Any) -> bool:
        """Whether the request's origin, if given, and its host are this server.

        Other host names are refused: another site could resolve its name to this address (DNS
        rebinding).
        """
        host, origin = headers.get("host", ""), headers.get("origin")
        if origin is not None and origin.partition("://")[2] != host:
            return False
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        with suppress(ValueError):
            ip_address(name)
            return True
        return name in self._names

    def _knows(self, token: str | None) -> bool:
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    # Resources.

    async def _page(self) -> Response:
        return HTMLResponse(_resource("index.html"))

    async def _scene(self) -> Response:
        data = await run_in_threadpool(scene_of, self._console.rig, self._console.scene)
        return JSONResponse(data)

    async def _files(self) -> Response:
        return JSONResponse(await run_in_threadpool(plans_and_scenes))

    async def _preview(self) -> Response:
        if self._console.plan.preview is None:
            raise HTTPException(404, "no plan is loaded")
        return JSONResponse(self._console.plan.preview)

    async def _compared(self) -> Response:
        if self._console.plan.compared is None:
            raise HTTPException(404, "no plan is compared")
        return JSONResponse(self._console.plan.compared)

    async def _picture(self, name: str) -> Response:
        """The newest image of a measuring camera."""
        made = await run_in_threadpool(self._console.pictures.jpeg, name)
        if made is None:
            return Response(status_code=204)  # the page retries
        return Response(made, media_type="image/jpeg")

    async def _stop(self) -> Response:
        """STOP without a socket; needs no token."""
        why_not = await _run_in(self._stops, self._console.stop)
        return JSONResponse({"ok": not why_not, "what": why_not})

    # The socket.

    async def _socket(self, page: WebSocket) -> None:
        known = self._knows(page.query_params.get("token"))
        if not (known and "origin" in page.headers and self._is_same_origin(page.headers)):
            await page.close(4403)
            return
        if self._pages >= MOST_PAGES:
            await page.close(1013)
            return
        self._pages += 1
        try:
            await self._serve_page(page)
        finally:
            self._pages -= 1

    async def _serve_page(self, page: WebSocket) -> None:
        """Serves a page until it disconnects; reading its socket waits for nothing else.

        Else reports of a held control could queue, and keep moving the robot after its release.
        """
        await page.accept()
        number = self._console.control.join("?" if page.client is None else page.client.host)
        inbox, flow = Inbox(), StateFlow()
        tasks = [
            asyncio.create_task(_or_disconnect(page, work))
            for work in (
                self._send_states(page, number, flow),
                self._execute_commands(page, number, inbox.commands),
                self._execute_commands(page, number, inbox.to_run),
                self._forward_held(inbox),
                self._forward_releases(inbox),
                _send_refusals(page, inbox),
            )
        ]
        try:
            while True:
                self._take(page, number, await page.receive_text(), inbox, flow)
        except (WebSocketDisconnect, RuntimeError, KeyError):  # KeyError: binary
            pass
        finally:
            for task in tasks:
                task.cancel()
            await run_in_threadpool(self._console.leave, number)

    async def _send_states(self, page: WebSocket, number: int, flow: StateFlow) -> None:
        """Sends the newest state, whenever the page has acknowledged enough of those before."""
        seen = 0  # no state before the first update
        while True:
            try:
                await asyncio.wait_for(flow.room(), UNSEEN)
            except TimeoutError:
                return await _disconnect(page)
            async with self._news:
                while self._times.seq == seen:
                    await self._news.wait()
                seen = self._times.seq
            flow.send(seen)
            own = {"control": self._console.control.as_dict(number), "echo": flow.echo}
            state = {**self._state, "seq": seen, "made_ms": 1e3 * self._times.newest, **own}
            try:
                await asyncio.wait_for(page.send_json(state), PATIENCE)
            except (TimeoutError, RuntimeError, WebSocketDisconnect):
                return await _disconnect(page)

    def _take(self, page: WebSocket, number: int, text: str, inbox: Inbox, flow: StateFlow) -> None:
        """Begins STOP at once; passes everything else to the page's tasks."""
        try:
            message = parse_message(text)
        except NotAMessage as error:
            inbox.refuse(0, str(error))
            return
        now = asyncio.get_running_loop().time()
        if isinstance(message, Seen):
            flow.take(message, now)
        elif isinstance(message, Held):
            if (behind := self._times.behind(message.state, now)) <= BEHIND:
                inbox.hold(self._console.held(number, message), message)
                return
            released = LetGo(kind="let_go", hold=message.hold)
            inbox.let_go(self._console.let_go(number, released))
            inbox.refuse(0, f"the connection is too slow to jog: {behind:.1f} s behind")
        elif isinstance(message, LetGo):
            inbox.let_go(self._console.let_go(number, message))
        elif message.command == "stop":
            stopping = asyncio.create_task(self._stop_and_answer(page, message))
            self._stopping.add(stopping)  # completes even if the page disconnects
            stopping.add_done_callback(self._stopping.discard)
        else:
            inbox.take(message)

    async def _stop_and_answer(self, page: WebSocket, message: Message) -> None:
        why_not = await _run_in(self._stops, self._console.stop)
        await _answer(page, message.id, why_not)

    async def _execute_commands(
        self, page: WebSocket, number: int, queue: asyncio.Queue[tuple[Message, float]]
    ) -> None:
        while True:
            message, arrived = await queue.get()
            why_not = await run_in_threadpool(self._console.command, number, message, arrived)
            await _answer(page, message.id, why_not)

    async def _forward_held(self, inbox: Inbox) -> None:
        """Forwards the newest report of a held control; one that waited too long is dropped."""
        while True:
            report = await inbox.held.take()
            await _run_in(self._presses, self._console.forward_held, *report)

    async def _forward_releases(self, inbox: Inbox) -> None:
        while True:
            press = await inbox.released.take()
            await _run_in(self._presses, self._console.end_press, press)


async def _run_in(pool: ThreadPoolExecutor, work: Callable[..., T], *arguments: Any) -> T:
    """Works in threads of its own, so that it waits for no other request."""
    return await asyncio.get_running_loop().run_in_executor(pool, work, *arguments)


async def _or_disconnect(page: WebSocket, work: Coroutine[Any, Any, None]) -> None:
    """Serves a page; if that fails, disconnects it: no page is left open without a state."""
    try:
        await work
    except Exception:
        await _disconnect(page)
        raise


async def _disconnect(page: WebSocket) -> None:
    with suppress(RuntimeError):  # it is gone already
        await page.close(1013)


async def _send_refusals(page: WebSocket, inbox: Inbox) -> None:
    while True:
        await _answer(page, *await inbox.refused.get())


async def _answer(page: WebSocket, command: int, why_not: str) -> None:
    answer = {"kind": "answer", "to": command, "ok": not why_not, "what": why_not}
    with suppress(RuntimeError, WebSocketDisconnect):  # the page is closed
        await page.send_json(answer)


def _resource(name: str) -> str:
    return files("cdpr.console").joinpath("static", name).read_text(encoding="utf-8")


async def _static(name: str) -> Response:
    """Files of the page, and those shared with reports."""
    is_shared = name in ("base.css", "viewer.js") or name.startswith("vendor/")
    root = files("model.pages") if is_shared else files("cdpr.console").joinpath("static")
    kind = _KINDS.get(Path(name).suffix)
    if kind is None or ".." in Path(name).parts or name.startswith("/"):
        raise HTTPException(404)
    try:
        return Response(root.joinpath(name).read_bytes(), media_type=kind)
    except (OSError, ValueError):
        raise HTTPException(404) from None


async def _run_file(name: str) -> Response:
    """A file below the folder of runs."""
    with suppress(OSError, ValueError):  # too long, or with a zero byte
        path, root = (RUNS / name).resolve(), RUNS.resolve()
        if path.is_relative_to(root) and path.is_file():
            return FileResponse(path)
    raise HTTPException(404)


async def _help(code: str) -> Response:
    """The help page of an event or fault."""
    if code not in fault_codes():
        raise HTTPException(404)
    return Response(page_text(code), media_type=_KINDS[".md"])


def run_server(console: Console, host: str, port: int, on_ready: Callable[[str], None]) -> None:
    """Serves the pages until interrupted.

    Args:
        console: The console to serve.
        host: Address to listen on.
        port: 0 for a free one.
        on_ready: Called with the page's address once the server listens.

    Raises:
        BadInput: The address cannot be used.
    """
    with listening(host, port) as listener:
        server = ConsoleServer(console, host=host)
        on_ready(f"http://{_in_address(host)}:{listener.getsockname()[1]}/?token={server.token}")
        take_short_turns()
        with prompt_threads():
            web_server(server.app()).run(sockets=[listener])


def _in_address(host: str) -> str:
    """A host for a browser's address; this machine's name, if the server listens everywhere."""
    with suppress(ValueError):
        if ip_address(host).is_unspecified:
            return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def web_server(app: FastAPI) -> uvicorn.Server:
    """The HTTP and WebSocket server of a console's application."""
    # A warning for each bad request would fill a pipe that nobody reads, and block the server.
    # Compression would cost processor time, and 40 kB for each page until it is collected.
    config = uvicorn.Config(app, log_level="error", ws_max_size=4096, ws_per_message_deflate=False)
    return uvicorn.Server(config)


@contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A listening socket.

    Raises:
        BadInput: The address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With its protocol, for asyncio sends without delay (TCP_NODELAY) only where it is stated.
    with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen(64)  # before the address is printed
        except (OSError, UnicodeError) as error:
            where, why = "--host", "this is not an address of this machine"
            then = "pass an address of this machine, such as 127.0.0.1"
            if getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES):
                where, why = "--port", "another program uses the port, or it is reserved for root"
                then = "pass another --port, or 0 for a free one"
            what = f"cannot listen on {host}:{port}: {getattr(error, 'strerror', None) or error}"
            raise BadInput(what, where=where, why=why, next_step=then) from None
        yield listener
