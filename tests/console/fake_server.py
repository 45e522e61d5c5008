"""A server that speaks the console's protocol without drives, for the page's tests and makers.

    python -m tests.console.fake_server --port 8402

It moves the platform of the paper's rig on a circle and executes commands in simplified form. `POST
/fake` lays values over the states that it sends (`{"state": {…}}`) and over its own (`{"set":
{…}}`), makes it silent (`{"silent": true}`), hang up (`{"hang_up": true}`), refuse sockets
(`{"refuse": true}`) or begin again (`{"renew": true}`). `GET /fake` gives what came in.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import math
import socket
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse, JSONResponse, PlainTextResponse

from cdpr.console.view import scene_of
from model.pages.scene import (
    Label,
    Moment,
    SceneFigure,
    SceneSurface,
    Stroke,
    frame_surface,
    grid_floor,
    platform_surface,
    scene_data,
)
from model.pose import Array, Pose
from model.rig import load_rig
from model.shapes import box_solid
from model.statics.gravity import working_tensions

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "cdpr" / "console" / "static"
TOKEN = "token-of-the-fake"
PERIOD_S = 0.05
#: The circle: its centre and radius, [m], and the time of one round at full speed, [s].
CENTRE, RADIUS, ROUND_S = np.array([0.05, 0.05, 0.4]), 0.14, 24.0
#: The page may load nothing from outside and run nothing but its files.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self';"
    " img-src 'self' data:"
)
RIG = load_rig(ROOT / "configs" / "gachon_8_6.yaml")


def on_circle(share: float) -> Array:
    """A point of the circle, [m]."""
    angle = 2.0 * math.pi * share
    return CENTRE + RADIUS * np.array(
        [math.cos(angle), math.sin(angle), 0.3 * math.sin(2.0 * angle)]
    )


def figure(moments: tuple[Moment, ...] = (), path: bool = False) -> SceneFigure:
    """The scene of the rig, or of the plan."""
    obstacles = tuple(
        SceneSurface(
            "obstacles", "obstacle", solid.vertices, solid.faces, solid.edges, 0.62, "obstacle_1"
        )
        for solid in [
            box_solid(np.array([0.04, 0.04, 0.225]), Pose.level(np.array([-0.15, 0.0, 0.225])))
        ]
    )
    frame = frame_surface(RIG)
    strokes: tuple[Stroke, ...] = (grid_floor(frame.vertices)[0],)
    labels: tuple[Label, ...] = ()
    if path:
        points = np.array([on_circle(k / 96) for k in range(97)])
        strokes, labels = (
            (Stroke.along("path", "ink", points, 4.5),),
            (Label("path", "start", points[0], "ring"),),
        )
    surfaces = obstacles if path else (frame, *obstacles)
    return SceneFigure(surfaces, strokes, labels, RIG.anchors, platform_surface(RIG), moments)


def preview(name: str) -> dict[str, Any]:
    """A loaded plan, with its curves."""
    shares = [k / 48 for k in range(49)]
    moments = tuple(Moment(ROUND_S * s, on_circle(s), np.eye(3), RIG.outlets) for s in shares)
    data = scene_data(figure(moments, path=True))
    tensions = np.array([working_tensions(RIG, Pose.level(on_circle(s))).tensions for s in shares])
    passed = "colliding" not in name
    return {
        "name": name,
        "hash": f"hash of {name}",
        "passed": passed,
        "verdict": "passed its check"
        if passed
        else "collides: 3.1 mm to obstacle_1 where 10 mm are required",
        "checks": [
            "clearance at least 10 mm on all 49 poses",
            "every wrench feasible",
            "speed, acceleration, jerk",
        ],
        "duration_s": ROUND_S,
        "length_mm": 921.4 if passed else None,
        "least_clearance_mm": 12.4 if passed else None,
        "largest_tension_n": 61.5 if passed else None,
        **{key: data[key] for key in ("moments", "strokes", "surfaces", "labels")},
        "curves": {
            "time_s": [ROUND_S * s for s in shares],
            "clearance_mm": [18.0 + 12.0 * math.cos(2.0 * math.pi * s) for s in shares],
            "required_mm": 10.0,
            "tensions_n": np.round(tensions.T, 2).tolist(),
        },
    }


class Fake:
    """The state sent, and the messages received."""

    def __init__(self) -> None:
        self.over: dict[str, Any] = {}
        self.silent = self.refuse = False
        self.ticks = 0
        self.received: list[dict[str, Any]] = []
        self.stops = 0
        self.sockets: dict[WebSocket, str] = {}
        self.in_control: WebSocket | None = None
        self.latched: str | None = None
        self.homed = True
        self.plan: str | None = None
        self.compared: str | None = None
        self.refusal = ""  # of every command of the page in control
        self.stop_refusal = ""  # of STOP, though a motion here stops
        self.poses: list[dict[str, Any]] = []
        self.outcome: dict[str, Any] | None = None
        self.share = self.rate = 0.0
        self.wished = {"stop": False, "hold": False, "speed_percent": 100}
        self.moving: str | None = None  # state of the motion
        self.began = time.monotonic()
        self.jog_ready = self.cable_ready = self.service = False
        self.cables_mm = [0.0] * 8
        self.press_mm = 0.0
        self.position = on_circle(0.0)
        self.held: dict[str, Any] | None = None
        self.held_at, self.spent = 0.0, -1
        self.events: list[dict[str, Any]] = []
        self.pictures: list[float] = []
        self.slow_ms = 0
        self.seen: dict[WebSocket, dict[str, float]] = {}
        self.behind_ms = 0.0  # how much longer states take to the page
        self.planning: str | None = None  # the plan being made
        self.planning_ticks = 0  # until it is made
        self.files = {
            "scenes": ["configs/environment_1.yaml", "configs/hall_pillar.yaml"],
            "plans": ["plans/circle.json", "plans/colliding.json"],
            "left_out": [],
        }
        self._seq = itertools.count(1)

    def tick(self) -> None:
        """One period of the motion."""
        self.ticks += 1
        if self.planning is not None:
            self.planning_ticks -= 1
            if self.planning_ticks <= 0:
                self.plan, self.planning = self.planning, None
                self._finish("plan", True, "planned and checked: 921 mm in 24.0 s")
        if self.moving:
            wished = (
                0.0
                if self.wished["stop"] or self.wished["hold"]
                else self.wished["speed_percent"] / 100.0
            )
            self.rate += float(np.clip(wished - self.rate, -0.1, 0.1))
            self.share = min(1.0, self.share + self.rate * PERIOD_S / ROUND_S)
            self.position = on_circle(self.share)
            self.moving = (
                "stopping"
                if self.wished["stop"]
                else "holding"
                if self.wished["hold"]
                else "moving"
            )
            if self.share >= 1.0 or (self.wished["stop"] and self.rate <= 0.0):
                self._end(stopped=self.wished["stop"])
        if self.held and time.monotonic() - self.held_at > 0.15:
            self.spent, self.held = max(self.spent, self.held["hold"]), None
        if self.held and self.cable_ready:
            sign = 1.0 if self.held["sense"] == "pay_out" else -1.0
            travel = sign * self.held["speed_mm_s"] * PERIOD_S
            self.cables_mm[self.held["cable"] - 1] += travel
            self.press_mm += travel
        elif self.held:
            step = np.array(self.held["direction"]) * self.held["speed_mm_s"] * PERIOD_S / 1e3
            self.position = np.clip(self.position + step, RIG.workspace_lower, RIG.workspace_upper)

    def _end(self, stopped: bool) -> None:
        self.event(
            "stop" if stopped else "end",
            "stopped by the operator" if stopped else "the end of the path",
        )
        facts = "bus            udp_multicast 239.74.163.2, 8 drives\nplan           circle.json\n"
        text = facts + (
            "STOPPED Stopped along the path by the operator."
            if stopped
            else "PASSED The run reached the goal.\n  Least clearance 12.4 mm."
        )
        self._finish("run", not stopped, text, stopped=stopped, report="/report")
        self.moving, self.rate = None, 0.0

    def _finish(
        self, verb: str, ok: bool, text: str, *, stopped: bool = False, report: str | None = None
    ) -> None:
        self.outcome = {
            "verb": verb,
            "ok": ok,
            "stopped": stopped,
            "text": text,
            "report": report,
            "fault_page": None,
        }

    def event(self, code: str, text: str) -> None:
        at = round(time.monotonic() - self.began, 2)
        self.events = [*self.events, {"time_s": at, "code": code, "text": text}][-12:]

    def state(self, reader: WebSocket) -> dict[str, Any]:
        """The state for one page."""
        name = None if self.in_control is None else self.sockets.get(self.in_control)
        tensions = working_tensions(RIG, Pose.level(self.position)).tensions
        near = float(np.linalg.norm(self.position[:2] - [-0.15, 0.0]) - 0.115) * 1e3
        jog = {
            "ready": self.jog_ready,
            "why_not": None,
            "moving": self.jog_ready and self.held is not None,
            "limit": None,
            "room_mm": None,
            "not_begun": None,
        }
        if self.held and near < 60.0:
            jog.update(limit="clearance to obstacle_1", room_mm=near - 10.0)
        busy = None
        if self.planning is not None:
            busy = {"verb": "plan", "text": "searching"}
        elif self.moving or self.jog_ready or self.cable_ready:
            verb = "run" if self.moving else "jog"
            busy = {
                "verb": verb,
                "text": "on the path" if self.moving else "drives enabled for jogging",
            }
        return {
            "kind": "state",
            "seq": next(self._seq),
            "read_only": False,
            "rig": RIG.name,
            "bus": "udp_multicast 239.74.163.2",
            "simulated": True,
            "homes_by": None,
            "home_mm": [0.0, 0.0, 445.0],
            "control": {
                "yours": reader is self.in_control,
                "held_by": name,
                "mode": self._mode(reader),
            },
            "latched": self.latched,
            "moved_by": None,
            "reference": {
                "counts": self.homed,
                "known": True,
                "why_not": None if self.homed else "cable 3 was switched on again",
            },
            "busy": busy,
            "outcome": self.outcome,
            "motion": self._motion(tensions),
            "platform": {
                "position_mm": np.round(self.position * 1e3, 2).tolist(),
                "tilt_deg": 0.12,
                "turn_deg": -0.31,
                "rotation": np.eye(3).reshape(-1).tolist(),
                "exits_mm": np.round(RIG.outlets * 1e3, 1).tolist(),
                "source": "drives",
            },
            "tensions_n": np.round(tensions, 2).tolist(),
            "tension_limits_n": [RIG.min_tension, RIG.max_tension],
            "clearance_mm": {
                "now": round(near, 1),
                "required": 10.0,
                "pair": ["cable 5", "obstacle_1"],
                "points_mm": [
                    np.round(self.position * 1e3, 1).tolist(),
                    [-110.0, 0.0, 430.0],
                ],
            },
            "measured": self._measured(near),
            "drives_read": None,
            "made_ms": 1e3 * time.monotonic() - self.behind_ms,
            "echo": self.seen.get(reader),
            "next_stop": self._next_stop(),
            "preview": self.plan,
            "plan_start_off_mm": None if self.plan is None else 0.0,
            "compared": self.compared,
            "jog": {**jog, "speed_mm_s": 20.0},
            "cable": self._cable(),
            "poses": self.poses,
            **self.over,
        }

    def _mode(self, reader: WebSocket) -> str:
        if reader is not self.in_control:
            return "observe"
        return "service" if self.service else "operate"

    def _cable(self) -> dict[str, Any]:
        held = self.held if self.cable_ready else None
        return {
            "ready": self.cable_ready,
            "why_not": None if self.cable_ready else "the drives are not enabled",
            "moving": held is not None,
            "cable": held and held["cable"],
            "press_mm": round(self.press_mm, 3),
            "session_mm": [round(mm, 3) for mm in self.cables_mm],
            "limit": None,
            "limit_n": 62.0 if self.cable_ready else None,
            "speed_mm_s": 20.0,
        }

    def _next_stop(self) -> dict[str, Any] | None:
        if not self.moving:
            return None
        left = 1.0 - self.share
        return {
            "name": "goal",
            "distance_mm": round(921.4 * left, 1),
            "seconds": round(ROUND_S * left, 1),
        }

    def _measured(self, near: float) -> dict[str, Any] | None:
        if self.moving is None:
            return None
        return {
            "position_mm": np.round(self.position * 1e3 + [0.21, -0.13, 0.3], 2).tolist(),
            "half_axes_mm": [[0.12, 0.0, 0.0], [0.0, 0.15, 0.05], [0.0, -0.14, 0.42]],
            "within_mm": 0.443,
            "stated": True,
            "age_s": 0.08,
            "clearance": {
                "distance_mm": round(near + 0.2, 3),
                "low_mm": round(near - 0.4, 3),
                "high_mm": round(near + 0.8, 3),
                "pair": ["cable 5", "obstacle_1"],
            },
        }

    def _motion(self, tensions: Array) -> dict[str, Any] | None:
        if self.moving is None:
            return None
        wobble = math.sin(7.0 * time.monotonic())
        drives = [
            {
                "node": k,
                "state": "operation enabled",
                "torque": "enabled",
                "in_fault": False,
                "position_counts": 1000 * k,
                "set_counts": 1000 * k + 4,
                "tension_n": round(float(t), 1),
            }
            for k, t in enumerate(tensions, start=1)
        ]
        camera = {
            "name": "top",
            "source": "rendered",
            "pictures": 412,
            "poses": 409,
            "dropped": 1,
            "pictures_per_second": 9.8,
            "measuring_ms": 31.2,
            "tags": [301, 305],
            "trouble": None,
            "live_image": 7,
        }
        return {
            "process": 4711,
            "state": self.moving,
            "cause": None,
            "elapsed_s": round(time.monotonic() - self.began, 2),
            "path_mm": round(921.4 * self.share, 1),
            "path_length_mm": 921.4,
            "feed_percent": round(100.0 * self.rate, 1),
            "wished": self.wished,
            "lateness_ms": round(0.06 + 0.02 * wobble, 3),
            "worst_lateness_ms": 0.31,
            "following_error_mm": round(0.21 + 0.05 * wobble, 3),
            "lost_replies": 0,
            "rejected_frames": 0,
            "error_frames": 0,
            "cameras": [camera],
            "drives": drives,
            "events": self.events,
            "age_s": 0.01,
        }

    def take(self, page: WebSocket, message: dict[str, Any]) -> tuple[bool, str]:
        """Executes a page's command; returns whether it was done, and the answer."""
        kind = message["kind"]
        if kind == "seen":
            self.seen[page] = {"at_ms": message["at_ms"], "received_ms": 1e3 * time.monotonic()}
            return True, ""
        self.received.append(message)
        ready = self.cable_ready if "cable" in message else self.jog_ready
        if kind == "held" and ready and message["hold"] > self.spent:
            if self.held is None:
                self.press_mm = 0.0
            self.held, self.held_at = message, time.monotonic()
        if kind == "let_go":
            self.spent, self.held = max(self.spent, message["hold"]), None
        if kind != "command":
            return True, ""
        if message["command"] == "stop":
            return self.stop()
        if message["command"] == "take_control":
            if self.in_control not in (None, page) and not message.get("force"):
                return False, "another page has control"
            self.in_control = page
            return True, ""
        if page is not self.in_control:
            return False, "Take control first."
        return self._obey(message)

    def stop(self) -> tuple[bool, str]:
        self.stops += 1
        self.held = None
        if self.moving:
            self.wished = {**self.wished, "stop": True}
        if self.stop_refusal:
            return False, self.stop_refusal
        active = self.moving is not None or self.jog_ready or self.cable_ready
        return active, "" if active else "nothing moves"

    def _obey(self, message: dict[str, Any]) -> tuple[bool, str]:
        command, pose = message["command"], message.get("pose")
        if self.refusal:
            return False, self.refusal
        if command == "give_control":
            self.in_control, self.service = None, False
        elif command in ("service_begin", "service_end"):
            self.service = command == "service_begin"
            self.cable_ready &= self.service
        elif command == "cable_begin":
            self.cable_ready = True
        elif command == "run":
            self.moving, self.share, self.began, self.events = "moving", 0.0, time.monotonic(), []
            self.wished, self.outcome = {"stop": False, "hold": False, "speed_percent": 100}, None
            self.event("armed", "drives enabled, set-points checked")
        elif command in ("hold", "resume"):
            self.wished = {**self.wished, "hold": command == "hold"}
        elif command == "speed":
            self.wished = {**self.wished, "speed_percent": message["percent"]}
        elif command in ("jog_begin", "jog_end"):
            self.jog_ready, self.cable_ready = command == "jog_begin", False
        elif command == "reset":
            self.latched = None
        elif command == "read_drives":
            self.over["drives_read"] = {"at": "2026-01-02T19:12:05+09:00", "why_not": None}
        elif command in ("home", "release"):
            self.homed = command == "home"
        elif command == "load_plan":
            self.plan = message["file"]
        elif command == "plan":
            self.plan = self.outcome = None
            self.planning = message["scene"] or "console/taught.plan.json"
            self.planning_ticks = 8
        elif command == "compare":
            self.compared = message["file"]
        elif command == "teach_at":
            pose = {k: message[k] for k in ("name", "position_mm")}
            self.poses = [*self.poses, {**pose, "quaternion": [1, 0, 0, 0]}]
        elif command == "teach":
            position = np.round(self.position * 1e3, 1).tolist()
            self.poses = [
                *self.poses,
                {"name": message["name"], "position_mm": position, "quaternion": [1, 0, 0, 0]},
            ]
        elif command == "rename":
            self.poses = [
                {**p, "name": message["name"]} if p["name"] == pose else p for p in self.poses
            ]
        elif command == "forget":
            self.poses = [p for p in self.poses if p["name"] != pose]
        elif command == "move":
            rest = [p for p in self.poses if p["name"] != pose]
            moved = [p for p in self.poses if p["name"] == pose]
            self.poses = [*rest[: message["to"]], *moved, *rest[message["to"] :]]
        else:
            return False, f"no such command: {command}"
        return True, ""


def application(fake: Fake) -> FastAPI:
    """The routes of the console, and `/fake`."""
    app = FastAPI(lifespan=lambda _: moving(fake), openapi_url=None)

    @app.get("/")
    async def index() -> Response:
        text = (STATIC / "index.html").read_text(encoding="utf-8")
        text = text.replace('name="token" content=""', f'name="token" content="{TOKEN}"')
        return Response(text, media_type="text/html", headers={"Content-Security-Policy": POLICY})

    @app.get("/static/{name:path}")
    async def static(name: str) -> Response:
        is_shared = name in ("base.css", "viewer.js") or name.startswith("vendor/")
        root = ROOT / "model" / "pages" if is_shared else STATIC
        path = (root / name).resolve()
        inside = path.is_relative_to(root) and path.is_file()
        return FileResponse(path) if inside else PlainTextResponse("no such file", 404)

    @app.get("/scene")
    async def scene() -> Response:
        drawn = {k: v for k, v in scene_data(figure()).items() if k != "moments"}
        return JSONResponse({**scene_of(RIG, None), **drawn})

    @app.get("/api/files")
    async def files() -> Response:
        return JSONResponse(fake.files)

    @app.get("/api/preview")
    async def preview_of() -> Response:
        return JSONResponse(preview(fake.plan)) if fake.plan else PlainTextResponse("no plan", 404)

    @app.get("/camera/{name}")
    async def picture() -> Response:
        fake.pictures.append(time.monotonic())
        await asyncio.sleep(0.001 * fake.slow_ms)
        _, file = cv2.imencode(".jpg", np.full((480, 640), 90, np.uint8))
        return Response(file.tobytes(), media_type="image/jpeg")

    @app.get("/api/compared")
    async def compared_of() -> Response:
        if fake.compared is None:
            return PlainTextResponse("no plan", 404)
        return JSONResponse(preview(fake.compared))

    @app.post("/stop")
    async def stop() -> Response:
        ok, what = fake.stop()
        return JSONResponse({"ok": ok, "what": what})

    @app.get("/fake")
    @app.post("/fake")
    async def hooks(request: Request) -> Response:
        if request.method == "POST":
            asked = await request.json()
            if asked.get("renew"):
                for left in list(fake.sockets):
                    await left.close()
                fake.__init__()  # type: ignore[misc]
            fake.over.update(asked.get("state", {}))
            fake.silent = asked.get("silent", fake.silent)
            fake.refuse = asked.get("refuse", fake.refuse)
            for name, value in asked.get("set", {}).items():
                setattr(fake, name, value)
            if asked.get("hang_up"):
                for left in list(fake.sockets):
                    await left.close()
        position = np.round(fake.position * 1e3, 3).tolist()
        names = ("received", "stops", "ticks", "plan", "poses", "latched", "pictures", "files")
        return JSONResponse(
            {name: getattr(fake, name) for name in names} | {"position_mm": position}
        )

    @app.websocket("/ws")
    async def page(page: WebSocket) -> None:
        await speak(fake, page)

    return app


async def speak(fake: Fake, page: WebSocket) -> None:
    """Serves one page until it leaves."""
    if fake.refuse:
        return await page.close()
    await page.accept()
    fake.sockets[page] = f"page {len(fake.sockets) + 1}"
    try:
        while True:
            message = json.loads(await page.receive_text())
            ok, what = fake.take(page, message)
            if "id" in message:
                await page.send_json(
                    {"kind": "answer", "to": message["id"], "ok": ok, "what": what}
                )
    except (WebSocketDisconnect, RuntimeError):  # the latter when it was hung up here
        pass
    finally:
        fake.sockets.pop(page, None)
        fake.seen.pop(page, None)
        if fake.in_control is page:
            fake.in_control = None


@contextlib.asynccontextmanager
async def moving(fake: Fake) -> AsyncIterator[None]:
    """Moves the platform and sends every page the state, 20 times a second."""

    async def go_on() -> None:
        while True:
            fake.tick()
            for page in list(fake.sockets):
                if not fake.silent:
                    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                        await page.send_json(fake.state(page))
            await asyncio.sleep(PERIOD_S)

    task = asyncio.create_task(go_on())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def main() -> None:
    """Serves until terminated; prints its address."""
    parser = argparse.ArgumentParser(description="The console's protocol without drives.")
    parser.add_argument("--port", type=int, default=0)
    chosen = parser.parse_args()
    with socket.create_server(("127.0.0.1", chosen.port)) as listening:
        port = listening.getsockname()[1]
        sys.stdout.write(f"http://127.0.0.1:{port}/?token={TOKEN}\n")
        sys.stdout.flush()
        config = uvicorn.Config(
            application(Fake()), log_level="warning", timeout_graceful_shutdown=1
        )
        uvicorn.Server(config).run(sockets=[listening])


if __name__ == "__main__":
    main()
