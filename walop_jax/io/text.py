"""Text files, and plain data as JSON that every reader takes: without NaN and infinities."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from walop_jax.io.errors import fail
from walop_jax.io.inputs import check_input

_LARGEST = 1 << 24
"""Bytes of a text file beyond which it is none of ours."""


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file; `DataError`, with the name, if it is missing, beyond 16 MiB or not text in UTF-8."""
    try:
        if check_input(path).stat().st_size > _LARGEST:
            raise fail("is larger than 16 MiB", file=path, advice="is this the right file?")
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise fail(f"cannot be read: {error.strerror or error}", file=path) from None
    except UnicodeDecodeError:
        raise fail("is not text in UTF-8", file=path) from None


def json_text(value: Any) -> str:
    """The JSON text of a value, indented, with a final newline; null for what is not finite."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """The value with mappings as dicts, sequences as lists and numbers that are not finite as None."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
