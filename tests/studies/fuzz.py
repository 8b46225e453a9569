"""Damaged files: a clear error or the same answer, and how often it is neither.

    python tests/studies/fuzz.py [--sets 10000] [--others 2000] [--seed 0]

Half of the sets have checksums, half have none; the others are calibration products, catalogues (FITS, CSV, ECSV,
VOTable) and model files. Each file is damaged in one way and read; counted are, by kind of file:

error       a `DataError` (of model files ValueError) in one line
same        the answer of the sound file, to the last bit
word        another answer, with a remark that the sound file does not get
silent      another answer without a word
traceback   any other exception, and any warning of a library
slow        more than 10 s

Two exchanged words of four bytes leave every checksum of FITS as it was (a sum does not know the order of its terms):
they are a kind of damage of their own, `swap`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import handmade_run  # noqa: E402
from astropy.table import Table  # noqa: E402
from handmade_set import Handmade  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.calibration import UnavailableInstrument  # noqa: E402
from walop_jax.calibration.product import read_calibration, write_calibration  # noqa: E402
from walop_jax.data.calset import read_calibration_set  # noqa: E402
from walop_jax.data.user_tables import read_input_table  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.model_file import render  # noqa: E402
from walop_jax.fit.model_of_set import model_for  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.instrument import nominal_instrument  # noqa: E402
from walop_jax.science.catalogue import read_catalogue  # noqa: E402

SLOWEST = 10  # seconds
OUTCOMES = ("error", "same", "word", "silent", "traceback", "slow")


class SlowError(BaseException):
    """Reading took longer than `SLOWEST`."""


class Answer(NamedTuple):
    """What reading gives: a digest of all its numbers and names, and what it remarks on."""

    digest: str
    remarks: tuple[str, ...] = ()


class Subject(NamedTuple):
    """A sound file: its kind and bytes, the ending of its name, and how it is read."""

    kind: str
    content: bytes
    suffix: str
    read: Callable[[Path], Answer]


def digest(value: Any) -> str:
    """The same for values that are equal to the last bit, paths and digests of files apart."""
    found = hashlib.sha256()

    def add(part: Any) -> None:
        if isinstance(
            part, UnavailableInstrument
        ):  # of a product by another version: it answers with its reason
            part = str(part.reason)
        if dataclasses.is_dataclass(part) and not isinstance(part, type):
            part = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
        if isinstance(part, Mapping):
            for key in sorted(part, key=str):
                found.update(str(key).encode("utf-8", "surrogatepass"))
                add(part[key])
        elif isinstance(part, np.ndarray):
            found.update(f"{part.dtype.kind}{part.shape}".encode())
            plain = part.astype("U").tolist() if part.dtype.kind in "US" else None
            found.update(repr(plain).encode() if plain is not None else np.ascontiguousarray(part).tobytes())
        elif isinstance(part, list | tuple):
            for one in part:
                add(one)
        else:
            found.update(repr(part).encode("utf-8", "surrogatepass"))

    add(value)
    return found.hexdigest()


# ----------------------------------------------------------------------------------------------------- subjects


def _read_set(path: Path) -> Answer:
    calset = read_calibration_set(path)
    block = calset.intensities.block(0, len(calset.points))
    parts = (calset.instrument, calset.site, calset.exposures.columns(), calset.points, calset.sources)
    remarks = tuple(remark.replace(str(path), "") for remark in calset.remarks)
    return Answer(digest((*parts, calset.filters, block)), remarks)


def _read_product(path: Path) -> Answer:
    product = read_calibration(path, any_model=True)
    return Answer(digest(dataclasses.replace(product, inputs=(), path=None)))


def _read_catalogue(path: Path) -> Answer:
    return Answer(digest(read_catalogue(read_input_table(path), nominal_instrument("WALOP-SOUTH"))))


def _catalogue(folder: Path, suffix: str, form: str) -> bytes:
    count = np.array([[1e5 + 1000 * n + 10 * k for k in range(4)] for n in range(6)])
    columns: dict[str, Any] = {
        "ID": np.arange(6), "X": np.linspace(-0.2, 0.2, 6), "Y": np.linspace(0.2, -0.1, 6),
        "FILTER": np.array(["SDSS-r"] * 6), "TEFF": np.full(6, 5000.0),
    }  # fmt: skip
    columns |= {f"N{k}": count[:, k] for k in range(4)} | {
        f"N_ERR{k}": np.sqrt(count[:, k]) for k in range(4)
    }
    path = folder / f"catalogue{suffix}"
    Table(columns).write(path, format=form, overwrite=True)
    return path.read_bytes()


def subjects(folder: Path) -> list[Subject]:
    """Sound files of every kind."""
    sound = Handmade(folder).write("sound.fits")
    calset = read_calibration_set(sound)
    text = render(base_model(calset, throughput_degree=1))
    write_calibration(folder / "product.fits", handmade_run.product())

    def read_model(path: Path) -> Answer:
        model = model_for(calset, path.read_text(encoding="utf-8"))
        return Answer(digest((model.name, [repr(p) for p in model.parameters], model.effect_names)))

    forms = {".fits": "fits", ".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".vot": "votable"}
    return [
        Subject("set with checksums", sound.read_bytes(), ".fits", _read_set),
        Subject("set without", Handmade(folder).write(checksum=False).read_bytes(), ".fits", _read_set),
        Subject("product", (folder / "product.fits").read_bytes(), ".fits", _read_product),
        *(Subject(f"catalogue {s}", _catalogue(folder, s, f), s, _read_catalogue) for s, f in forms.items()),
        Subject("model file", text.encode(), ".toml", read_model),
    ]


# ------------------------------------------------------------------------------------------------------- damage


def damaged(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """A name for the damage, and the file with it."""
    size, kinds = len(content), ("bit", "byte", "letter", "burst", "zeros", "cut", "gone", "twice", "swap")
    kind = str(rng.choice(kinds))
    made, at = bytearray(content), int(rng.integers(size))
    length = int(rng.integers(1, 600))
    if kind == "bit":
        made[at] ^= 1 << int(rng.integers(8))
    elif kind == "byte":
        made[at] = int(rng.integers(256))
    elif kind == "letter":  # a letter or digit for another, where a file keeps its meaning
        letters = [n for n, byte in enumerate(content) if 48 <= byte < 123]
        made[letters[int(rng.integers(len(letters)))]] = int(rng.integers(48, 123))
    elif kind == "burst":
        made[at : at + length] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()[: size - at]
    elif kind == "zeros":
        made[at : at + length] = bytes(min(length, size - at))
    elif kind == "cut":
        del made[at:]
    elif kind == "gone":
        del made[at : at + length]
    elif kind == "twice":
        made[at:at] = made[at : at + length]
    else:
        one, other = 4 * rng.integers(0, max(size // 4, 1), 2)
        made[one : one + 4], made[other : other + 4] = made[other : other + 4], made[one : one + 4]
    return kind, bytes(made)


def outcome(subject: Subject, content: bytes, sound: Answer, path: Path) -> tuple[str, str]:
    """One of `OUTCOMES`, and what was said."""

    def late(*_: Any) -> None:
        raise SlowError

    path.write_bytes(content)
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SLOWEST)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = subject.read(path)
    except SlowError:
        return "slow", ""
    except (DataError, UnicodeDecodeError) as error:
        return ("error" if "\n" not in str(error) else "traceback"), str(error)
    except ValueError as error:
        return ("error" if subject.kind == "model file" else "traceback"), f"ValueError: {error}"
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    if found.digest == sound.digest:
        return "same", ""
    return ("word" if set(found.remarks) - set(sound.remarks) else "silent"), "; ".join(found.remarks)


def study(
    subject: Subject, count: int, rng: np.random.Generator, folder: Path
) -> tuple[Counter[tuple[str, str]], list[tuple[str, str, bytes]]]:
    """Numbers of (damage, outcome), and the files that were answered silently or not at all."""
    path = folder / f"damaged{subject.suffix}"
    path.write_bytes(subject.content)
    sound = subject.read(path)
    found: Counter[tuple[str, str]] = Counter()
    kept = []
    for _ in range(count):
        kind, content = damaged(subject.content, rng)
        result, said = outcome(subject, content, sound, path)
        found[kind, result] += 1
        if result in ("silent", "traceback", "slow"):
            kept.append((f"{kind} {result}", said, content))
    return found, kept


def main() -> int:
    parser = options_of(__doc__, sets=10000, others=2000, seed=0)
    parser.add_argument(
        "--keep", type=Path, default=None, help="folder for files answered silently or not at all"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    worst = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = subjects(folder)
        others = [s for s in made if not s.kind.startswith("set")]
        for number, subject in enumerate(made):
            count = options.sets // 2 if subject not in others else options.others // len(others)
            found, kept = study(subject, count, np.random.default_rng([options.seed, number]), folder)
            total = Counter[str]()
            for (_, result), times in found.items():
                total[result] += times
            line = ", ".join(f"{result} {total[result]}" for result in OUTCOMES)
            print(f"{subject.kind}: {count} files: {line}", flush=True)
            silent = {kind: times for (kind, result), times in sorted(found.items()) if result == "silent"}
            if silent:
                print(f"    silent by kind of damage: {silent}", flush=True)
            for n, (kind, said, content) in enumerate(kept):
                if "silent" not in kind:
                    print(f"    {kind}: {said[:200]}", flush=True)
                    worst += 1
                if options.keep is not None:
                    label = f"{subject.kind} {n} {kind}".replace(" ", "_")
                    (options.keep / f"{label}{subject.suffix}").write_bytes(content)
    return int(worst > 0)


if __name__ == "__main__":
    sys.exit(main())
