"""Keys of the terminal as they are pressed, for verbs that an operator drives by hand."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty

from executor.supervision import FASTEST, SLOWEST
from model.errors import BadInput

_ONE = re.compile(rb"\x1b[\[O][0-9;]*[A-Za-z~]|.", re.DOTALL)
_CHUNK = 4096
#: Keys that send more than one byte, by what follows the escape and ``[`` or ``O``.
NAMES = {
    b"A": "up",
    b"B": "down",
    b"C": "right",
    b"D": "left",
    b"5~": "page up",
    b"6~": "page down",
}


#: What + and - change a speed by, in per cent.
SPEED_STEP = 10


def speed_by_key(percent: int, key: str) -> int:
    """A speed after ``+`` or ``-``, in per cent of the largest."""
    step = SPEED_STEP if key == "+" else -SPEED_STEP
    return min(max(percent + step, SLOWEST), FASTEST)


class Keys:
    """Reads keys without Enter and without echo, to the end of the ``with`` block."""

    def __init__(self) -> None:
        """Of standard input.

        Raises:
            BadInput: It is no terminal.
        """
        if not sys.stdin.isatty():
            raise BadInput(
                "standard input is not a terminal",
                where="keys",
                next_step="run it in a terminal, without a pipe",
            )
        self._input = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._input)

    def __enter__(self) -> Keys:
        """Ctrl-C and Ctrl-Z keep their meaning."""
        tty.setcbreak(self._input)
        return self

    def __exit__(self, *_: object) -> None:
        """What was typed and not read is thrown away: it was not meant for the shell."""
        termios.tcsetattr(self._input, termios.TCSAFLUSH, self._before)

    def pressed(self, wait: float = 0.0) -> list[str]:
        """Keys pressed since the last call: characters, and names as in `NAMES`.

        Args:
            wait: For the first one, [s].
        """
        if not select.select([self._input], [], [], wait)[0]:
            return []
        return list(names_of(os.read(self._input, _CHUNK)))


def names_of(data: bytes) -> list[str]:
    """The keys in what a terminal sent; those without a name here are left out."""
    found = []
    for one in _ONE.findall(data):
        name = NAMES.get(one[2:]) if len(one) > 1 else one.decode("ascii", errors="ignore")
        if name:
            found.append(name)
    return found
