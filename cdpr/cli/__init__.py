"""The command line. Each verb imports what it needs when it is called."""

from __future__ import annotations

from cdpr.cli.app import main

__all__ = ["main"]
