"""The operator at the terminal: confirmation before a motion, signals and keys during it."""

from __future__ import annotations

import errno
import os
import re
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from rich.console import Console

from cdpr.cli.output import err, out, show_facts, show_line
from executor.proposals import Proposal
from executor.supervision import FASTEST, SLOWEST, RequestBoard, Supervisor
from model.errors import BadInput

_T = TypeVar("_T")

#: A closed terminal (SIGHUP) must not leave the rig without its loop.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_EVALUATING = b"\nthe motion has ended; the run is being evaluated, please wait for its verdict\n"
_GIVING_UP = b"\nskipping the files not yet written; press Ctrl-C again to exit at once\n"


def confirmation(*, asks: bool, as_json: bool) -> Callable[[Proposal], bool]:
    """A `confirm` callback: shows what will happen, then asks.

    Args:
        asks: Whether to ask; False with ``--yes``.
        as_json: Standard output is for a program, so the text goes to standard error.
    """

    def confirm(proposal: Proposal) -> bool:
        if asks or not as_json:
            show_proposal(proposal, err if as_json else out)
        return not asks or has_agreed(proposal.question, proposal.otherwise)

    return confirm


def show_proposal(proposal: Proposal, on: Console) -> None:
    """Shows what will happen."""
    facts = proposal.facts()
    if facts:
        show_facts(proposal.title, facts, on)
    else:
        show_line(proposal.title, on)


def has_agreed(question: str, otherwise: str) -> bool:
    """Whether the answer is yes; an empty answer means no.

    Args:
        question: Shown to the operator.
        otherwise: Outcome of a no, such as ``nothing was moved``.

    Raises:
        BadInput: Standard input has ended.
    """
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        print(file=sys.stderr)
        raise BadInput(
            f"no answer to: {question}",
            where="standard input",
            next_step=f"run the command in a terminal, or pass --yes; {otherwise}",
        )
    return answer.strip().lower() in ("y", "yes")


@contextmanager
def handling(
    handler: Callable[[int, FrameType | None], None],
    signals: Sequence[signal.Signals] = STOP_SIGNALS,
) -> Iterator[None]:
    """Routes signals of the operator, SIGHUP among them, to a function until the end of a block."""
    before = {number: signal.getsignal(number) for number in signals}
    if before[signal.SIGHUP] is signal.SIG_IGN:  # started with nohup: outlives its terminal
        del before[signal.SIGHUP]
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier if earlier is not None else signal.SIG_DFL)


@contextmanager
def stop_requests(board: RequestBoard) -> Iterator[None]:
    """Turns Ctrl-C, SIGTERM and a closed terminal into a stop request."""
    with handling(lambda _number, _frame: board.ask_stop()):
        yield


def _process_start() -> float:
    """When this process was started, [s] of `CLOCK_BOOTTIME`."""
    fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


class SignalSupervisor(Supervisor):
    """Turns the operator's signals into a stop during a motion."""

    def __init__(self) -> None:
        """Of this process, whose only task is the motion."""
        super().__init__()
        self.began = _process_start()

    def on_early_stop(self) -> None:
        """See `Supervisor`: as Ctrl-C, which also ends a question to the operator."""
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)

    def during(
        self,
        board: RequestBoard,
        motion: Callable[[], _T],
        conclude: Callable[[], object] = lambda: None,
    ) -> _T:
        """See `Supervisor`."""
        with stop_requests(board):
            result = motion()
        conclude()
        return result


class RunSupervisor(SignalSupervisor):
    """Handles Ctrl-C, SIGTERM and a closed terminal before, during and after a run's motion.

    After a motion, the exit code depends only on what the drives did: neither a closed terminal
    nor Ctrl-C during the report changes it.
    """

    def __init__(self, show: Callable[[Any], None]) -> None:
        """Before any motion.

        Args:
            show: Shows a `RunResult` when its verdict is known.
        """
        super().__init__()
        self.moved = False
        self.code: int | None = None
        """The exit code, once decided."""
        self._given_up = False
        self._show = show
        self._signals = ExitStack()

    def __enter__(self) -> RunSupervisor:
        """Signals have their usual meaning until `take_over`."""
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the usual meaning of signals."""
        self._signals.close()

    def take_over(self) -> None:
        """Takes over the signals, once the operator agreed to the run."""
        self._signals.enter_context(handling(self._on_signal))

    def on_motion(self) -> None:
        """See `Supervisor`."""
        self.moved = True

    def on_verdict(self, result: Any) -> None:
        """See `Supervisor`."""
        self.code = result.exit_code
        print_safely(lambda: self._show(result), result)

    def leaves_files_out(self) -> bool:
        """See `Supervisor`."""
        return self._given_up

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Interrupts before the motion, only answers until the verdict, then skips the files."""
        if not self.moved:
            raise KeyboardInterrupt
        if self._given_up and self.code is not None:
            os._exit(self.code)  # a disk that hangs would block any cleaner exit
        self._given_up = self.code is not None
        with suppress(OSError):  # print is not safe in a signal handler
            os.write(2, _GIVING_UP if self._given_up else _EVALUATING)


def print_safely(write: Callable[[], None], result: Any) -> None:
    """Writes to standard output; where that fails, the verdict to standard error.

    Args:
        write: Called to write the text.
        result: The `RunResult`.
    """
    try:
        write()
        sys.stdout.flush()
    except (Exception, SystemExit):  # rich ends the program when its pipe is closed
        with suppress(OSError, ValueError):
            output = sys.stdout.fileno()
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, output)  # or the interpreter fails to flush it at exit
            os.close(nothing)
        line = f"{result.verdict} {result.sentence}"
        show_line(line, err)


# Keys of the terminal as they are pressed.


_ONE = re.compile(rb"\x1b[\[O][0-9;]*[A-Za-z~]|.", re.DOTALL)
_CHUNK = 4096
#: Keys that send more than one byte, by the bytes after the escape and ``[`` or ``O``.
NAMES = {
    b"A": "up",
    b"B": "down",
    b"C": "right",
    b"D": "left",
    b"5~": "page up",
    b"6~": "page down",
}


#: Step of the speed for + and -, in per cent.
SPEED_STEP = 10


def speed_by_key(percent: int, key: str) -> int:
    """The speed after ``+`` or ``-``, in per cent of the largest."""
    step = SPEED_STEP if key == "+" else -SPEED_STEP
    return min(max(percent + step, SLOWEST), FASTEST)


class Keys:
    """Reads keys without Enter and without echo until the end of the ``with`` block."""

    def __init__(self) -> None:
        """Keys from standard input.

        Raises:
            BadInput: It is not a terminal.
        """
        if not sys.stdin.isatty():
            raise BadInput(
                "standard input is not a terminal",
                where="keys",
                next_step="run the command in a terminal, without a pipe",
            )
        self._input = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._input)

    def __enter__(self) -> Keys:
        """Ctrl-C and Ctrl-Z keep their meaning."""
        tty.setcbreak(self._input)
        return self

    def __exit__(self, *_: object) -> None:
        """Discards keys typed but not read: they were not meant for the shell."""
        with suppress(termios.error):  # not an OSError: the terminal was closed
            termios.tcsetattr(self._input, termios.TCSAFLUSH, self._before)

    def pressed(self, wait: float = 0.0) -> list[str]:
        """Keys pressed since the last call: characters, and names as in `NAMES`.

        Args:
            wait: Longest wait for the first one, [s].

        Raises:
            OSError: The terminal was closed.
        """
        if not select.select([self._input], [], [], wait)[0]:
            return []
        data = os.read(self._input, _CHUNK)
        if not data:  # what a closed terminal returns instead of an error, by its kind
            raise OSError(errno.EIO, "the terminal was closed")
        return list(names_of(data))


def names_of(data: bytes) -> list[str]:
    """The keys in the bytes of a terminal; keys without a name in `NAMES` are left out."""
    found = []
    for one in _ONE.findall(data):
        name = NAMES.get(one[2:]) if len(one) > 1 else one.decode("ascii", errors="ignore")
        if name:
            found.append(name)
    return found
