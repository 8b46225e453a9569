"""Commands that have not moved to the room `commands` yet."""

from __future__ import annotations

import importlib

INTERRUPTED = 130


def main() -> None:
    """Run the program."""
    importlib.import_module("walop_jax.commands").main()
