"""What the cameras of a run tell while it goes on: to the operator, the record and the loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.markup import escape

from cdpr.cli.camera_line import rates
from cdpr.cli.output import err, spinner

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from executor.run_cameras import RunCameras, Seen
    from executor.status import RunStatus
    from executor.wishes import WishBoard

#: Takes in an event: its code, its text, and when it was, on the loop's clock [s].
Tell = Callable[[str, str, float], None]


class RunWatch:
    """Asks the cameras for pictures, and stops the run when they see too little clearance."""

    def __init__(
        self,
        cameras: RunCameras,
        status: RunStatus,
        board: WishBoard,
        tell: Tell,
        *,
        clearance_stop: bool,
    ) -> None:
        """Nothing was asked for yet.

        Args:
            cameras: Those of the run.
            status: Kept up to date for those who ask.
            board: Where a stop is asked for.
            tell: Takes in what happens.
            clearance_stop: Ask for a stop when clearance is too small.
        """
        self.rates = ""
        """How fast each camera is and how many tags it sees, for the progress bar."""
        self._cameras, self._status, self._board = cameras, status, board
        self._tell, self._clearance_stop = tell, clearance_stop

    def trigger(
        self, time: float, asked: float, true_pose: Pose | None, by_drives: Pose | None
    ) -> None:
        """A picture is due; arguments as for `RunCameras.trigger`."""
        self._cameras.trigger(time, asked, true_pose, by_drives)
        self._tell_news(asked)
        each = self._cameras.as_dict()
        self._status.take_cameras(each)
        self.rates = "; ".join(
            f"{c['name']} {rates(c['pictures_per_second'], c['measuring_ms'], len(c['tags']))}"
            for c in each
        )
        near, all_failed = self._cameras.near, self._cameras.all_failed
        if near and self._clearance_stop:
            who = "the cameras" if len(each) > 1 else "the camera"
            less = f"{who} measured less clearance than the scene asks for: {near}"
            self._stop("too near", near, "clearance_low", less)
        if all_failed:
            self._stop("stopping", all_failed, "camera", all_failed)

    def finish(self, at: float, quiet: bool) -> Seen:
        """Waits for the last pictures.

        Args:
            at: The end of the run, on the loop's clock, [s].
            quiet: Nothing shows that it waits.
        """
        with spinner("waiting for the last pictures", not quiet):
            seen = self._cameras.finish(lambda: self._board.read().stop)
        self._tell_news(at)
        for camera in seen.cameras:
            if camera.dropped:
                what = f"{camera.dropped} of {camera.dropped + camera.pictures} pictures left out"
                text = f"camera {camera.name}: {what}, the one before was not done"
                self._tell("pictures_dropped", text, at)
        return seen

    def _stop(self, label: str, told: str, code: str, why: str) -> None:
        """Asks for a stop, unless one is under way."""
        from executor.wishes import StopReason

        if self._board.read().stop:
            return
        self._board.ask_stop(StopReason(code, why))
        err.print(f"[red]{label}[/] {escape(told)}", soft_wrap=True)

    def _tell_news(self, at: float) -> None:
        for news in self._cameras.news():
            self._tell(news.code, news.text, at)
            err.print(f"[yellow]remark[/] {escape(news.text)}", soft_wrap=True)
