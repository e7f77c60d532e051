"""The command `wlm`: one file a command group, no logic of its own."""

from wlm.cli.app import app, main

__all__ = ["app", "main"]
