"""The folder of a run: which files it holds, and its JSON documents."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection
from pathlib import Path
from typing import Any

from walop_jax.io.errors import fail
from walop_jax.io.names import DOCUMENTS, FAILED, PRODUCT, SUMMARY
from walop_jax.io.text import read_json

OF_A_FIT = "give the RUN of walop-jax refit or diagnose"


@dataclasses.dataclass(frozen=True, repr=False)
class RunFolder:
    """The files in a folder that commands have written; documents are read when they are asked for."""

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))

    def __contains__(self, name: str) -> bool:
        return (self.folder / name).exists()

    def wanted(self, name: str, advice: str = OF_A_FIT) -> Path:
        """The path of a file of the run; `DataError`, with advice, where it is not there."""
        if not self.folder.is_dir():
            raise fail("is not the folder of a run", file=self.folder, advice=OF_A_FIT)
        if name in (SUMMARY, PRODUCT) and name not in self and FAILED in self:
            what = f"the fit of this run did not converge; its end is described in {FAILED}"
            raise fail(what, file=self.folder, advice="look at the data with walop-jax inspect, then refit")
        if name not in self:
            raise fail(f"holds no {name}", file=self.folder, advice=advice)
        return self.folder / name

    def document(self, name: str, keys: Collection[str] = ()) -> dict[str, Any]:
        """The JSON document of a file; `DataError` where it is none, or lacks one of `keys`."""
        path, advice = self.folder / name, "run the command that made it again"
        content = read_json(path)
        if not isinstance(content, dict):
            raise fail("is no document of a run", file=path, advice=advice)
        for key in keys:
            if key not in content:
                raise fail(f"has no {key!r}", file=path, advice=advice)
        return content

    @functools.cached_property
    def documents(self) -> dict[str, dict[str, Any]]:
        """The JSON documents of the run by name: those of `DOCUMENTS` that are there."""
        return {name: self.document(file) for name, file in DOCUMENTS.items() if file in self}
