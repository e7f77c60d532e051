"""The command line `wlm`: one module for each group of commands; the work is done by the other packages."""

from wlm.cli.app import app, main

__all__ = ["app", "main"]
