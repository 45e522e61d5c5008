"""Whether a camera measures the platform now, or has lost it."""

from __future__ import annotations

#: So many pictures in a row without a pose mean that the camera looks elsewhere or the light is
#: gone.
BLIND_PICTURES = 10
#: A camera that answers nothing for so long hangs, [s].
SILENCE = 2.0


class CameraSight:
    """Knows what was asked of a camera, and what came back."""

    def __init__(self) -> None:
        """Nothing was asked for yet."""
        self._asked: float | None = None
        self._blind = 0

    def ask(self, at: float) -> None:
        """A picture was asked for, at this time, [s]."""
        self._asked = at

    def answer(self, seen: bool) -> None:
        """That picture is measured.

        Args:
            seen: It gave a pose.
        """
        self._asked, self._blind = None, 0 if seen else self._blind + 1

    def trouble(self, now: float) -> str:
        """Why no pose is measured any more, as what the camera does; nothing while all is well.

        Args:
            now: On the clock of `ask`, [s].
        """
        if self._asked is not None and now - self._asked > SILENCE:
            return f"gave no answer for {SILENCE:g} s"
        if self._blind >= BLIND_PICTURES:
            return (
                f"gave no pose in {BLIND_PICTURES} pictures in a row (is it where the rig file"
                " says, are tags in view and lit?)"
            )
        return ""
