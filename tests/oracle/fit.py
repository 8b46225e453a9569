"""Joint fit of the oracle's base model to a calibration set, and its error against a known matrix."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from . import forward

NODES = 60
"""Gauss nodes in the band: within 1e-10 of the whole table for the instrument, 3e-8 behind three plates."""


class Vector:
    """The free parameters of a fit as one vector: scalars, throughput coefficients, standards.

    Gauges are held: the flux of every row is free, hence the overall scale of the throughputs (the constant
    of the first camera, kept where it starts), or for a series in the exponent its whole first camera.
    """

    def __init__(self, start, data, log=False):
        plate = any(c is not None for _, _, c in data["configurations"])
        moon = np.any(data["kind"] == "moon")
        unused = {*(() if plate else ("quartz_c", "mgf2_c")), *(() if moon else ("delta",))}
        self.start = start
        self.names = [k for k in forward.NOMINAL if k not in unused]
        self.free = np.ones(np.shape(start["throughput"]), bool)
        if not np.any(data["kind"] == "flux"):
            self.free[0, slice(None) if log else 0] = False
        steps = [forward.PRIOR_WIDTH.get(k, 0.01) for k in self.names] + [0.01] * self.free.sum()
        if data["sources"] is not None:
            steps += [*data["sources"]["Q_ERR"], *data["sources"]["U_ERR"]]
        self.steps = np.array(steps)
        self.priors = sum(k in forward.PRIOR_WIDTH for k in self.names) + 2 * np.size(start["q"])

    def pack(self, params):
        scalars = np.array([params[k] for k in self.names])
        return np.concatenate([scalars, params["throughput"][self.free], params["q"], params["u"]])

    def unpack(self, vector):
        cut = np.cumsum([len(self.names), self.free.sum(), np.size(self.start["q"])])
        scalars, coefficients, q, u = np.split(vector, cut)
        throughput = np.array(self.start["throughput"])
        throughput[self.free] = coefficients
        values = dict(zip(self.names, map(float, scalars), strict=True))
        return {**self.start, **values, "throughput": throughput, "q": q, "u": u}


def fit(data, start=None, nodes=NODES, scale=forward.SCALE, log=False, verbose=0):
    """Least-squares fit of the base model: parameters, covariance, χ², degrees of freedom, scipy's result."""
    if start is None:
        catalogue = data["sources"]
        start = forward.nominal(0 if catalogue is None else catalogue["Q"].size)
        if catalogue is not None:
            start["q"], start["u"] = catalogue["Q"].copy(), catalogue["U"].copy()
        if log:
            start["throughput"][:, 0] = np.log(0.5)
    vector = Vector(start, data, log)

    def function(values):
        return forward.residuals(vector.unpack(values), data, nodes, scale, log)

    def jacobian(values):
        columns = []
        # parameters that leave the optics alone come first: their optics are those of `values` itself
        names = vector.names
        order = sorted(range(values.size), key=lambda i: i < len(names) and names[i] in forward.OPTICS)
        function(values)
        for i in order:
            step = np.zeros_like(values)
            step[i] = 0.01 * vector.steps[i]
            columns.append((function(values + step) - function(values - step)) / (2 * step[i]))
        out = np.empty((columns[0].size, values.size))
        out[:, order] = np.stack(columns, -1)
        return out

    result = least_squares(
        function, vector.pack(start), jacobian, x_scale=vector.steps, xtol=1e-8, ftol=1e-8, verbose=verbose
    )
    scaled = result.jac * vector.steps
    known = np.count_nonzero(data["kind"] == "flux")
    return {
        "params": vector.unpack(result.x),
        "covariance": np.linalg.inv(scaled.T @ scaled) * vector.steps[:, None] * vector.steps,
        "chi2": 2 * result.cost,
        "dof": 3 * data["point"].size + known + vector.priors - result.x.size,
        "result": result,
        "vector": vector,
    }


def recovery_error(found, true, p=0.05, angles=36):
    """Errors (points,) rms over the angle in q and u of a source of degree `p`, calibrated with `found`."""
    theta = np.arange(angles) * np.pi / angles
    source = p * np.stack([np.cos(2 * theta), np.sin(2 * theta)])

    def parts(m):
        offset = np.stack([m["m21"], m["m31"]], -1)
        return offset, np.stack([np.stack([m["m22"], m["m23"]], -1), np.stack([m["m32"], m["m33"]], -1)], -2)

    offset, linear = parts(true)
    offset_found, linear_found = parts(found)
    measured = offset[..., None] + linear @ source
    recovered = np.linalg.solve(linear_found, measured - offset_found[..., None])
    rms = np.sqrt(np.mean((recovered - source) ** 2, -1))
    return rms[:, 0], rms[:, 1]
