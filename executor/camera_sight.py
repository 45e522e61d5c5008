"""Whether the camera measures the platform now, or has lost it."""

from __future__ import annotations

#: So many pictures in a row without a pose mean that the camera looks elsewhere or the light is
#: gone.
BLIND_PICTURES = 10
#: A camera that answers nothing for so long hangs, [s].
SILENCE = 2.0


class CameraSight:
    """Knows what was asked of the camera, and what came back."""

    def __init__(self) -> None:
        """Nothing was asked for yet."""
        self._asked: float | None = None
        self._blind = 0

    def ask(self, at: float) -> None:
        """A picture was asked for, at this time, [s]."""
        self._asked = at

    def answer(self, blind: int) -> None:
        """That picture is measured.

        Args:
            blind: So many pictures in a row, this one the last, gave no pose.
        """
        self._asked, self._blind = None, blind

    def trouble(self, now: float) -> str:
        """Why no pose is measured any more; nothing while all is well.

        Args:
            now: On the clock of `ask`, [s].
        """
        if self._asked is not None and now - self._asked > SILENCE:
            return f"the camera gave no answer for {SILENCE:g} s; clearance is not measured"
        if self._blind >= BLIND_PICTURES:
            return (
                f"{BLIND_PICTURES} pictures in a row gave no pose; clearance is not measured:"
                " is the camera where the rig file says, are tags in view and lit?"
            )
        return ""
