"""The console's web server: one page, its files, one socket a page. Nothing moves because of it."""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from cdpr.console.commands import Held, LetGo, Message, NotAMessage, parse_message
from cdpr.console.session import MADE, Console
from cdpr.console.view import scene_of
from executor.recording.record_files import RUNS
from executor.recording.verdict import fault_codes, page_text
from model.errors import BadInput

#: States a second.
RATE = 20.0
#: A page that does not take its states for so long is let go, [s].
PATIENCE = 2.0
#: Pages that may be open at a time; STOP by `POST /stop` needs none.
MOST_PAGES = 64
#: Commands of a page that may wait for the one before; STOP never does.
MOST_WAITING = 8
STOPS_AT_ONCE = 4
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

    def __init__(self, console: Console, token: str | None = None, host: str = "") -> None:
        """No page is open.

        Args:
            console: What is shown and done.
            token: Of the address; without one it is drawn.
            host: A name of this machine by which pages ask, beside its own.
        """
        self.token = token or secrets.token_urlsafe(18)
        self._names = {"localhost", socket.gethostname().lower(), host.lower()}
        self._pages = 0
        self._console = console
        self._state: dict[str, Any] = {}
        self._news = asyncio.Condition()
        self._seq = 0
        self._stops = ThreadPoolExecutor(STOPS_AT_ONCE, "cdpr-stop")
        self._stopping: set[asyncio.Task[None]] = set()

    def app(self) -> Starlette:
        """The application for any ASGI server."""
        return Starlette(
            routes=[
                Route("/", self._page),
                Route("/static/{name:path}", _static),
                Route("/scene", self._scene),
                Route("/api/files", self._files),
                Route("/api/preview", self._preview),
                Route("/api/compared", self._compared),
                Route("/camera/{name}", self._picture),
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
            self._stops.shutdown()
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
        if not self._asks_us(request.headers):
            return Response("another origin, or another name than this machine's", 403)
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

    def _asks_us(self, headers: Any) -> bool:
        """The page that asks, if a browser names one, is ours, and asks by our name or address.

        Other names may be another site's, which lets them point here to be of one origin with us.
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

    async def _compared(self, _request: Request) -> Response:
        if self._console.compared is None:
            raise HTTPException(404, "no plan is compared")
        return JSONResponse(self._console.compared)

    async def _picture(self, request: Request) -> Response:
        """The newest image of a camera that measures."""
        name = request.path_params["name"]
        made = await run_in_threadpool(self._console.pictures.jpeg, name)
        if made is None:
            return Response(status_code=204)  # the page asks again
        return Response(made, media_type="image/jpeg")

    async def _stop(self, _request: Request) -> Response:
        """For a page whose socket is lost; anybody may stop."""
        why_not = await self._at_once(self._console.stop)
        return JSONResponse({"ok": not why_not, "what": why_not})

    async def _at_once(self, stop: Callable[..., str], *arguments: Any) -> str:
        """STOP waits for nothing else that pages ask for: it has threads of its own."""
        return await asyncio.get_running_loop().run_in_executor(self._stops, stop, *arguments)

    # The socket.

    async def _socket(self, page: WebSocket) -> None:
        known = self._knows(page.query_params.get("token"))
        if not (known and "origin" in page.headers and self._asks_us(page.headers)):
            await page.close(4403)
            return
        if self._pages >= MOST_PAGES:
            await page.close(1013)
            return
        self._pages += 1
        try:
            await self._speak(page)
        finally:
            self._pages -= 1

    async def _speak(self, page: WebSocket) -> None:
        await page.accept()
        number = self._console.control.join("?" if page.client is None else page.client.host)
        commands: asyncio.Queue[Message] = asyncio.Queue(MOST_WAITING)
        tasks = [
            asyncio.create_task(self._tell(page, number)),
            asyncio.create_task(self._obey(page, number, commands)),
        ]
        try:
            while True:
                await self._hear(page, number, await page.receive_text(), commands)
        except (WebSocketDisconnect, RuntimeError, KeyError):  # the last for what is no text
            pass
        finally:
            for task in tasks:
                task.cancel()
            await run_in_threadpool(self._console.leave, number)

    async def _tell(self, page: WebSocket, number: int) -> None:
        seen = 0  # before the first look there is nothing to tell
        while True:
            async with self._news:
                while self._seq == seen:
                    await self._news.wait()
                seen = self._seq
            control = self._console.control
            own = {
                "yours": control.holder == number,
                "held_by": control.holder_name(),
                "mode": control.mode(number),
            }
            state = {**self._state, "seq": seen, "control": own}
            try:
                await asyncio.wait_for(page.send_json(state), PATIENCE)
            except (TimeoutError, RuntimeError, WebSocketDisconnect):
                with suppress(RuntimeError):
                    await page.close(1013)
                return

    async def _hear(
        self, page: WebSocket, number: int, text: str, commands: asyncio.Queue[Message]
    ) -> None:
        """What is held and let go counts at once, STOP too; other commands wait for each other."""
        try:
            message = parse_message(text)
        except NotAMessage as error:
            await page.send_json({"kind": "answer", "to": 0, "ok": False, "what": str(error)})
            return
        if isinstance(message, Held):
            await run_in_threadpool(self._console.held, number, message)
        elif isinstance(message, LetGo):
            await run_in_threadpool(self._console.let_go, number, message)
        elif message.command == "stop":
            stopping = asyncio.create_task(self._stop_and_answer(page, number, message))
            self._stopping.add(stopping)  # it is done even if the page is gone by then
            stopping.add_done_callback(self._stopping.discard)
        elif commands.full():
            await _answer(page, message, "what this page asked for before is not done yet")
        else:
            commands.put_nowait(message)

    async def _stop_and_answer(self, page: WebSocket, number: int, message: Message) -> None:
        why_not = await self._at_once(self._console.command, number, message)
        await _answer(page, message, why_not)

    async def _obey(self, page: WebSocket, number: int, commands: asyncio.Queue[Message]) -> None:
        while True:
            message = await commands.get()
            why_not = await run_in_threadpool(self._console.command, number, message)
            await _answer(page, message, why_not)


async def _answer(page: WebSocket, message: Message, why_not: str) -> None:
    answer = {"kind": "answer", "to": message.id, "ok": not why_not, "what": why_not}
    with suppress(RuntimeError, WebSocketDisconnect):  # it is gone
        await page.send_json(answer)


def _resource(name: str) -> str:
    return files("cdpr.console").joinpath("static", name).read_text(encoding="utf-8")


async def _static(request: Request) -> Response:
    """Files of the page, and those that it shares with reports."""
    name = request.path_params["name"]
    is_shared = name in ("base.css", "viewer.js") or name.startswith("vendor/")
    root = files("model.pages") if is_shared else files("cdpr.console").joinpath("static")
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


def run_server(console: Console, host: str, port: int, on_ready: Callable[[str], None]) -> None:
    """Serves the pages until it is interrupted.

    Args:
        console: What is shown and done.
        host: Address to listen on.
        port: 0 for a free one.
        on_ready: Called with the address of the page, once it can be opened.

    Raises:
        BadInput: The address cannot be used.
    """
    with _listening(host, port) as listener:
        server = ConsoleServer(console, host=host)
        on_ready(f"http://{host}:{listener.getsockname()[1]}/?token={server.token}")
        config = uvicorn.Config(server.app(), log_level="warning", ws_max_size=4096)
        uvicorn.Server(config).run(sockets=[listener])


@contextmanager
def _listening(host: str, port: int) -> Iterator[socket.socket]:
    """A socket for the pages.

    Raises:
        BadInput: The address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen(64)  # before the address is printed
        except OSError as error:
            raise BadInput(
                f"cannot listen on {host}:{port}: {error.strerror or error}",
                where="--port",
                why="another program uses the port, or the address is not this machine's",
                next_step="pass another --port, or 0 for a free one",
            ) from None
        yield listener
