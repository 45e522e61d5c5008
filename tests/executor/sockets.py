"""Command sockets of a run, without the run."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from executor.remote.command_socket import advertised_ahead


@contextmanager
def advertised() -> Iterator[list[socket.socket]]:
    """Listens under the name of a motion in preparation and that of a run while the block runs."""
    with advertised_ahead() as sockets:
        sockets.advertise()
        yield sockets.listeners
