"""The command line: parse, call one function per command, print. Nothing is computed here.

Heavy imports stand inside the commands, so that help appears at once.
"""

from walop_jax.cli.app import app, main

__all__ = ["app", "main"]
