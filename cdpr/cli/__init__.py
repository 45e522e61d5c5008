"""The command line; a verb's module is imported when the verb is called."""

from __future__ import annotations

from cdpr.cli.app import main

__all__ = ["main"]
