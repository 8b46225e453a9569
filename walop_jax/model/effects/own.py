"""Effects that users bring along: a TOML or Python file beside the catalogue that comes with the package."""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence

from walop_jax.io.code import classes_of
from walop_jax.io.errors import fail
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.base import Effect
from walop_jax.model.effects.catalogue import own_entries


def catalogue_with(
    own: str | os.PathLike[str] | None, catalogue: Sequence[type[Effect]] = EFFECTS
) -> tuple[type[Effect], ...]:
    """The catalogue followed by the effects of a file (None: nothing more): entries of a TOML file, classes of Python.

    A Python file is run. Raises `DataError` if it cannot be, defines no effect, or one without a name or with that of
    another.
    """
    if own is None:
        return tuple(catalogue)
    if os.fspath(own).endswith(".toml"):
        found = {effect.name: effect for effect in own_entries(own)}
    else:
        found = classes_of(
            own,
            Effect,
            "give a TOML file, or Python with subclasses of Effect (walop-jax docs adding-an-effect)",
        )
        found = {name: effect for name, effect in found.items() if not inspect.isabstract(effect)}
    if not found:
        raise fail("defines no effect", file=own, advice="see walop-jax docs adding-an-effect")
    taken = {effect.name for effect in catalogue}
    for class_name, effect in found.items():
        if not effect.name or effect.name in taken:
            what = f"{class_name} has {'the name of another effect' if effect.name else 'no name'}"
            raise fail(what, file=own, advice="give it a name of its own")
        taken.add(effect.name)
    return (*catalogue, *found.values())
