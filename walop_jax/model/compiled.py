"""Compilation with the options of this package, and traced programs kept on disk.

JAX keeps compiled code between processes, under the text of the program; but for the text Python must trace the optics
with all their derivatives, which takes longer than most fits. So the text (StableHLO, `jax.export`) is kept as well,
under a key of its dependences: the name of the function, the structure of its arguments with all non-numbers (elements,
effects, choices), shapes and types, the source of this package and the versions of the tracing packages. Programs with
other arguments (a class of a user, a closure) are not kept, nor are programs that cannot be exported.

Programs are kept where JAX's cache folder has a folder `programs`, which the command line makes; like compiled
code they are executed: the folder must be the user's own. A damaged file is written anew.

On CPU the fusion emitters of XLA compute shared sub-expressions over and over when a derivative of the plates is
compiled (measured with jax 0.10.2: a first fit takes 18 s of CPU instead of 11 s, later calls as long; plates solved
one by one took 9.6 s a call instead of 0.08 s), so they are switched off there where XLA has the option (that of jax
0.12 has not). Those versions of XLA also take `mueller.computed_once` away before loops are fused, unless that pass is
left out.
`tests/model/test_compiled.py` guards this. Programs of one or two calls are not worth optimising.

Without optimisation, these change the time of compilation by −10 to +17 %, with jax 0.10.2 and 0.12, less than single
runs scatter, and are left as they are: `xla_cpu_opt_preset` (FAST_COMPILE), `xla_llvm_disable_expensive_passes`,
`jax_optimization_level`; so is `xla_cpu_parallel_codegen_split_count`, which has saved up to a third of some programs
with 0.10.2 and nothing with 0.12.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import operator
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax import export

from walop_jax.io.code import cores

FOLDER = "programs"
CACHE_VARIABLE = "WALOP_JAX_CACHE"
_DIGEST = hashlib.sha256().digest_size
_PACKAGES = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
_KNOWN = ("walop_jax", "builtins", "types", "functools", "operator", "_operator", *_PACKAGES)
_MOST = 500  # programs that are kept, those used last
_STARTED = time.time()
"""A younger source file is not the running code."""


class _NotKept(Exception):
    """A program with dependences beyond its key."""


def folder() -> Path | None:
    """Folder of kept programs; None without one."""
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    path = Path(cache) / FOLDER if cache else None
    return path if path is not None and path.is_dir() else None


def program(
    directory: Path,
    name: str,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    options: dict[str, Any] | None,
) -> Callable[..., Any] | None:
    """Program of `function` for arguments like these, from the folder or new to it; None where it cannot be kept."""
    leaves, tree = jax.tree.flatten(args)
    try:
        key = _key(name, tree.unflatten(range(tree.num_leaves)), [kind(leaf) for leaf in leaves])
        stored = _read(directory / key)
        if stored is None:
            stored = _traced(function, tree, leaves)
            _write(directory / key, stored)
        structure, exported = stored[0], export.deserialize(bytearray(stored[1]))
    except Exception:  # the call itself raises the error, if it matters
        return None
    run, shape = jax.jit(exported.call, compiler_options=options), jax.tree.structure(structure)
    return lambda *args: shape.unflatten(run(*jax.tree.leaves(args)))


def kind(leaf: Any) -> tuple[Any, ...]:
    """Kind of a number: shape, type and weakness of the type."""
    aval = leaf.aval if isinstance(leaf, jax.Array) else jax.typeof(leaf)
    return aval.shape, aval.dtype, bool(aval.weak_type)


def _traced(function: Callable[..., Any], tree: Any, leaves: Sequence[Any]) -> tuple[Any, bytes]:
    """The structure of the results of a program, and the program as bytes."""
    shapes: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        results, shape = jax.tree.flatten(function(*tree.unflatten(leaves)))
        shapes.append(shape)
        return results

    exported = export.export(jax.jit(flat))(*leaves)
    return shapes[-1].unflatten(range(shapes[-1].num_leaves)), bytes(exported.serialize())


def _key(name: str, structure: Any, kinds: Sequence[Any]) -> str:
    flags = os.environ.get("XLA_FLAGS", "")
    double = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    description = repr((name, kinds, jax.default_backend(), double, flags)) + json.dumps(_plain(structure))
    return hashlib.sha256(_source() + description.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """A structure in the types of JSON, equal for equal structures: collections are lists that begin with their kind.

    Raises `_NotKept` for classes and functions that are not of this package and its libraries, and for other objects.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        return ["array", str(array.dtype), array.shape, array.tobytes().hex()]
    if isinstance(value, Mapping):
        return ["dict", *([_plain(key), _plain(entry)] for key, entry in value.items())]
    if isinstance(value, frozenset | set):
        return ["frozenset", *sorted(map(_plain, value), key=json.dumps)]
    if type(value) in (tuple, list):
        return [type(value).__name__, *map(_plain, value)]
    if isinstance(value, type) or (callable(value) and hasattr(value, "__qualname__")):
        return ["name", _name(value)]
    if isinstance(value, tuple):
        return ["named", _name(type(value)), *map(_plain, value)]
    if not dataclasses.is_dataclass(value):
        raise _NotKept(type(value))
    fields = {f.name: _plain(vars(value)[f.name]) for f in dataclasses.fields(value) if f.name in vars(value)}
    return ["object", _name(type(value)), fields]


def _name(value: Any) -> str:
    """Module and name of a class or function. Raises `_NotKept` unless the name leads to it."""
    module, name = value.__module__ or "", value.__qualname__
    if module.partition(".")[0] not in _KNOWN or _found(f"{module}:{name}") is not value:
        raise _NotKept(name)
    return f"{module}:{name}"


def _found(name: str) -> Any:
    module, _, path = name.partition(":")
    try:
        return operator.attrgetter(path)(sys.modules[module])
    except (AttributeError, KeyError):
        return None


def _made(plain: Any) -> Any:
    """Inverse of `_plain` for results of programs: numbers in dicts, tuples, named tuples, lists and objects."""
    if not isinstance(plain, list):
        return plain
    kind, *entries = plain
    if kind == "dict":
        return {_made(key): _made(entry) for key, entry in entries}
    if kind == "object":
        instance = object.__new__(_found(entries[0]))
        for name, value in entries[1].items():
            object.__setattr__(instance, name, _made(value))
        return instance
    if kind == "named":
        return _found(entries[0])._make(map(_made, entries[1:]))
    return {"tuple": tuple, "list": list}[kind](map(_made, entries))


@functools.cache
def _source() -> bytes:
    """Digest of the source of this package and of the versions of the tracing packages. Raises `_NotKept`."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256(sys.version.encode())
    for package in _PACKAGES:
        digest.update(f"{package} {importlib.metadata.version(package)}".encode())
    for path in sorted((*root.rglob("*.py"), *root.rglob("effects/*.toml"))):
        if path.stat().st_mtime > _STARTED:
            raise _NotKept(str(path))
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.digest()


def _read(path: Path) -> tuple[Any, bytes] | None:
    """Structure and bytes of a file; None for a missing or damaged one."""
    with contextlib.suppress(OSError):
        content = path.read_bytes()
        if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST]:
            os.utime(path)
            text, _, payload = content[_DIGEST:].partition(b"\n")
            return _made(json.loads(text)), payload
    return None


def _write(path: Path, kept: tuple[Any, bytes]) -> None:
    """Write a program in one step and remove the oldest beyond `_MOST`; failures of the disk are ignored."""
    content = json.dumps(_plain(kept[0])).encode() + b"\n" + kept[1]
    with contextlib.suppress(OSError):
        handle, name = tempfile.mkstemp(dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(name, path)
        except OSError:
            os.unlink(name)
            raise
        for old in sorted(path.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-_MOST]:
            old.unlink()


# ---------------------------------------------------------------------------------------------------------- compilation

Result = TypeVar("Result")


EMITTERS = "xla_cpu_use_fusion_emitters"
BARRIERS = "cse_barrier_expander"  # pass that removes the barriers of `mueller.computed_once` too early


@functools.cache
def knows(option: str) -> bool:
    """True for an option of this version of XLA."""
    try:
        jax.jit(lambda: 0, compiler_options={option: False}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def compiled(
    function: Callable[..., Result], *, optimised_above: float = -1, fuse: bool = False, kept_as: str = ""
) -> Callable[..., Result]:
    """`jax.jit` with this package's options; the back end is looked up at the first call, not at import.

    Code for a `Plan` whose `work` is not above `optimised_above` is not optimised: faster to compile, slower to run.
    Where an optimised program for such arguments is there already, it serves them as well.
    `fuse` leaves the fusion emitters on, for a function without derivatives of the plates. `kept_as` names the traced
    program between processes (`program`), for a function of its arguments alone.
    """

    def options(once: bool) -> dict[str, Any] | None:
        on_cpu = jax.default_backend() == "cpu"
        chosen: dict[str, Any] = {}
        if on_cpu and knows(EMITTERS):
            chosen = {"xla_disable_hlo_passes": BARRIERS} | ({} if fuse else {EMITTERS: False})
        if once:
            chosen["xla_backend_optimization_level"] = 0
        return chosen or None

    @functools.cache
    def jitted(once: bool) -> Any:
        return jax.jit(function, compiler_options=options(once))

    programs: dict[Any, Any] = {}

    def run_for(args: tuple[Any, ...], once: bool) -> Any:
        """The program for arguments like these: a kept one if possible, from disk if it is there."""
        directory = folder() if kept_as else None
        if directory is None and optimised_above < 0:  # no choice, and nothing to look up
            return jitted(False)
        leaves, tree = jax.tree.flatten(args)
        at = directory, tree, tuple(kind(leaf) for leaf in leaves)
        once = once and (*at, False) not in programs
        if (*at, once) not in programs:
            stored = directory and program(directory, kept_as, function, args, options(once))
            programs[*at, once] = stored or jitted(once)
        return programs[*at, once]

    @functools.wraps(function)
    def call(*args: Any) -> Result:
        _refuse_float32(args)
        once = optimised_above >= 0 and any(getattr(arg, "work", np.inf) <= optimised_above for arg in args)
        with float64():
            return run_for(args, once)(*args)

    return call


def derivatives(function: Callable[..., Any], at: tuple[Any, ...], steps: tuple[Any, ...]) -> tuple[Any, Any]:
    """Value of a function `at` its arguments, and its derivatives along steps: trees like these, a leading axis more.

    Traced once; `jax.linearize`, and its linear part under `jax.vmap`, are two traces, which take a third longer.
    """
    return jax.vmap(lambda *step: jax.jvp(function, at, step), out_axes=(None, 0))(*steps)


def array(values: Any, kind: Any = None) -> jax.Array:
    """Numbers as an array of JAX, outside of programs: `jnp.asarray` would compile a program for each shape."""
    if isinstance(values, jax.Array):
        return values
    with float64():
        return jax.device_put(np.asarray(values, kind))


# ------------------------------------------------------------------------------------------------------------- float64


def float64() -> contextlib.AbstractContextManager[Any]:
    """JAX computes in float64 in the block, by the calling thread alone; the rest of the session stays as it is."""
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return contextlib.nullcontext()
    module = jax if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental")  # jax < 0.8
    return module.enable_x64(True)


def usual_threads() -> int:
    """Default number of simultaneous pieces of work."""
    devices = len(jax.local_devices())
    if devices > 1 or jax.default_backend() != "cpu":
        return 2 * devices  # one computes while the next one is read
    return cores()


def cache_folder() -> Path | None:
    """Folder of compiled code between runs; None when switched off or impossible.

    WALOP_JAX_CACHE names the folder ("off": none), otherwise it is walop-jax/xla in the user's cache folder.
    """
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen.lower() in ("off", "0", "none"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        path = Path(chosen) if chosen else Path(base) / "walop-jax" / "xla"
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home
        return None
    return path if os.access(path, os.W_OK | os.X_OK) else None


def switch_on() -> None:
    """Switch JAX on for a program: float64, and the cache of compiled code, which makes later runs start fast."""
    jax.config.update("jax_enable_x64", True)
    # Where in the source an operation is from: nobody asks a program for it, and it is a tenth of tracing.
    jax.config.update("jax_traceback_in_locations_limit", 0)
    path = cache_folder()
    if path is not None:
        with contextlib.suppress(OSError):
            (path / FOLDER).mkdir(exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        jax.config.update("jax_raise_persistent_cache_errors", False)


def in_float64(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """The function, computing in float64 whatever the session does, under its public name."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with float64():
            return function(*args, **kwargs)

    run.__module__, run.__qualname__ = "walop_jax", name  # for look-ups by name, as of pickle
    return run


_REMEDY = 'call jax.config.update("jax_enable_x64", True) before anything else, or set JAX_ENABLE_X64=1'


def need_float64(what: str) -> None:
    """Raise RuntimeError, with the remedy, where the session compiles in float32."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(f"{what} is computed in float64, which is switched off: {_REMEDY}")


def _refuse_float32(args: tuple[Any, ...]) -> None:
    """Raise RuntimeError, with the remedy, for numbers in float32: their digits are lost."""
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return
    if any(getattr(leaf, "dtype", None) == np.float32 for leaf in jax.tree.leaves(args)):
        what = "walop_jax computes in float64, which is switched off, and was given numbers in float32"
        raise RuntimeError(f"{what}: {_REMEDY}")
