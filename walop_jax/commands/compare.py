"""`walop-jax compare`: the published method and the joint model on the same calibration set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands import products
from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, figure_file, typed
from walop_jax.commands.inputs import ModelLike, Sets, set_and_model, set_of
from walop_jax.commands.products import CalibrationLike, Effects, InstrumentLike
from walop_jax.io.errors import fail
from walop_jax.io.names import COMPARISON

if TYPE_CHECKING:
    from walop_jax.paper.comparison import Comparison

TABLE = "comparison.fits"
FIGURES = {f"comparison_{name}.png": f"{name}_figure" for name in ("histogram", "map", "offset", "spectral")}


OPTIONS = {
    "output": Option("Folder of the results.", metavar="RUN", kind=Path, short="-o", required=True),
    "truth": Option("True X, Y, M21 … M33 (FITS, CSV), for simulated sets.", metavar="TABLE", kind=Path),
    "filter": Option("Filter to compare in.", metavar="NAME"),
}


@command(
    stages=("reading", "fitting", "judging"),
    writes=(COMPARISON, TABLE, *FIGURES),
    random=True,
    options=OPTIONS,
)
def compare(
    job: Job,
    data: Sets,
    calibration: CalibrationLike | None = None,
    *,
    output: PathLike | None = None,
    truth: tuple[Any, Any, Any] | PathLike | None = None,
    filter: str = "SDSS-r",
    model: ModelLike = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
) -> Outcome[Comparison]:
    """Compare the method of Paper II, as it is published, with the joint fit.

    A quadratic per grid point, a transmission model per camera, 100 stars with p up to 5 %, corrections Δq and
    Δu; on the grid points and between them. The reference is the joint model, or the truth that comes with a
    simulated set. RUN/comparison.json has the statistics, comparison.fits every point, four figures the rest: also
    the spectral appendix and the full-Moon scheme. (Two calibrations are compared by check.)

    In Python: a `Comparison`; `calibration` is the joint fit (default: made here), `truth` a file, or (x, y, matrices)
    in memory, in degrees. Raises `DataError`, ahead of the joint fit, for a set with too few polariser angles for
    the polynomial, ValueError if the fit does not converge, and for a `calibration` or `truth` in memory together with
    `output`.

    >>> walop.compare("night.fits").document()["between"]  # doctest: +SKIP
    """
    from walop_jax import Calibration
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.refit import refit
    from walop_jax.io.plain_tables import astropy_table, write_table
    from walop_jax.paper.comparison import compare as comparison_of
    from walop_jax.paper.comparison import published_method
    from walop_jax.reports import paper_figures
    from walop_jax.science.field_points import true_matrices
    from walop_jax.science.star_errors import Truth

    if output is not None and (calibration is not None or isinstance(truth, tuple)):
        raise ValueError("with output the joint fit is repeated: leave out calibration and a truth in memory")
    job.begin("reading")
    held = None if calibration is None else products.calibration_of(calibration, effects)
    if held is None:
        calset, chosen = set_and_model(data, model, instrument, effects, output=output)
    else:
        calset, chosen = set_of(data, held.design), held.model
    if [len(arm.analyser.cameras) for arm in chosen.template.arms] != [2, 2]:
        what = f"Paper II has a method for two arms of two cameras, which {chosen.name} is not"
        raise fail(f"{what}; refit and diagnose")
    if truth is not None:
        in_memory = isinstance(truth, tuple)
        truth = Truth(*(truth if in_memory else true_matrices(truth, chosen.template.patched())))
    # Ahead of the joint fit, which takes longer: it is in vain where the polynomials cannot be fitted.
    published = published_method(calset, truth, filter, job.seed)
    if held is None:
        job.tell("fitting the joint model", "fitting")
        result = examined(refit(calset, chosen, progress=job.progress), job.seed)
        if not result.converged:
            raise ValueError(f"the joint fit did not converge ({result.minimum.message})")
        joint, trusted, warnings = Calibration.from_fit(result), result.trusted, result.warnings
    else:
        joint, trusted, warnings = held, held.verdict.trusted, held.warnings
    job.tell("judging the polynomials", "judging")
    compared = comparison_of(calset, joint, truth, filter, job.seed, published=published)
    lost = joint.left_behind
    columns = {name: (values, "", about) for name, (values, about) in compared.columns().items()}
    table = astropy_table(columns, products.left_out_cards(lost))
    pictures = {file: figure_file(getattr(paper_figures, name), compared) for file, name in FIGURES.items()}
    doubts = () if trusted else (f"the joint fit: {text}" for text in warnings)
    return Outcome(
        compared,
        extra={"trusted": trusted, products.NOT_CARRIED_OVER: list(lost)},
        below="" if output is None else f"Written to {output}.",
        files={TABLE: lambda path: write_table(path, table), **pictures},
        saved_as=COMPARISON,
        trusted=trusted,
        warnings=(*doubts, *products.left_out_sentences(lost)),
        next=(typed("report", output),),
    )
