"""The command line of a study: its docstring, and numbers with the values that they have in the published one."""

from __future__ import annotations

import argparse


def options_of(text: str | None, **numbers: float) -> argparse.ArgumentParser:
    """A parser with an option for each number; `text` is shown as it is written."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in numbers.items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    return parser
