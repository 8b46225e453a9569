"""The oracle against sets with known truth."""

from __future__ import annotations

import numpy as np

from . import forward

ELEMENTS = ("m21", "m22", "m23", "m31", "m32", "m33")
PLATE = {"": None, "_C0": 0.0, "_C45": 45.0}
AS_BUILT = {
    "magnification": "magnification",
    "distortion": "distortion",
    "wedge_1": "wedge_left",
    "wedge_2": "wedge_right",
    "coll": "collimator_diattenuation",
    **{k: k for k in ("quartz_1", "mgf2_1", "quartz_2", "mgf2_2", "quartz_c", "mgf2_c")},
}


def read_truth(south):
    """As-built parameters (constant throughputs) and the table of true matrices of a `SouthSet`."""
    from astropy.io import fits

    built = south.as_built()
    params = forward.nominal()
    params.update({ours: built[theirs] for ours, theirs in AS_BUILT.items()})
    params["eta_1"], params["eta_2"] = built["efficiency"]
    params["coll_q"], params["coll_u"] = built["collimator_bias"]
    params["throughput"][:, 0] = built["throughput"]
    with fits.open(south.matrix) as hdus:
        table = {column: np.array(hdus[1].data[column], float) for column in hdus[1].columns.names}
    return params, table


def truth_matrix(table, suffix=""):
    """m21 … m33 of a truth table."""
    return {k: table[k.upper() + suffix] for k in ELEMENTS}


def throughput_ratios(analysis, table):
    """Camera throughputs (points, 4) up to one factor per half that M21 and M31 of the truth imply.

    `analysis`: vectors of the as-built instrument with unit throughputs, calibration plate out.
    """
    ratios = np.ones(analysis.shape[:2])
    for a, name in ((0, "M21"), (2, "M31")):
        offset = table[name]
        ratios[:, a] = (1 + offset) / (1 - offset) * analysis[:, a + 1, 0] / analysis[:, a, 0]
    return ratios


def as_made(south, data):
    """The numbers that a set was made with, as a start; throughputs are nominal, standards those of the catalogue."""
    catalogue, true = data["sources"], read_truth(south)[0]
    start = forward.nominal(catalogue["Q"].size)
    start |= {name: value for name, value in true.items() if np.shape(start.get(name, ())) == np.shape(value)}
    return start | {"q": catalogue["Q"].copy(), "u": catalogue["U"].copy()}


def compare(params, table, wavelengths, weights):
    """Model minus truth of every element and plate setting, throughput ratios taken from the truth."""
    params = {**params, "throughput": np.eye(1, 15).repeat(4, 0)}
    ratios, out = None, {}
    for suffix, plate in PLATE.items():
        args = (params, table["X"], table["Y"], wavelengths, weights, plate)
        analysis = forward.analysis_vectors(*args)
        if ratios is None:
            ratios = throughput_ratios(analysis, table)
        model = forward.instrument_matrix(analysis * ratios[..., None])
        for k, value in truth_matrix(table, suffix).items():
            out[k + suffix] = model[k] - value
    return out
