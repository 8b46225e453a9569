"""The base model written a second time, from its definition alone: numpy, and astropy for the Moon.

An oracle: slow and literal on purpose, and free of any code of the package that it is held against. Every
face of every plate is a 4 × 4 solve of the tangential fields; the band is the tabulated curve itself.

Parameters live in a plain dict:

    magnification, distortion (1/deg²)         field to pupil
    wedge_1, wedge_2 (rad)                     front-face angle before HWP1, HWP2
    quartz_1, mgf2_1, quartz_2, mgf2_2 (µm)    half-wave plates
    quartz_c, mgf2_c (µm)                      calibration half-wave plate
    eta_1, eta_2                               analyser efficiency of each half
    coll (1/deg²), coll_q, coll_u              collimator diattenuation
    delta                                      Moon sky, maximum polarisation
    throughput (4, 15)                         Legendre coefficients per camera, terms as in `TERMS`
    q, u (sources)                             standards, equatorial frame

Conventions: fields ∝ exp(i(k·r − ωt)); V = 2 Im(E_x* E_y), positive when the electric vector turns from +X
toward +Y with time. Vectors of Stokes parameters are (I, Q, U, V).
"""

from __future__ import annotations

import numpy as np

NOMINAL = {
    "magnification": 15.63,
    "distortion": 0.02,
    "wedge_1": -0.230,
    "wedge_2": 0.230,
    "quartz_1": 2407.0,
    "mgf2_1": 1930.0,
    "quartz_2": 2407.0,
    "mgf2_2": 1930.0,
    "quartz_c": 2407.0,
    "mgf2_c": 1930.0,
    "eta_1": 0.999,
    "eta_2": 0.999,
    "coll": 0.012,
    "coll_q": 0.0,
    "coll_u": 0.0,
    "delta": 0.8,
}

PRIOR_WIDTH = {
    "magnification": 0.05,
    "distortion": 0.01,
    "wedge_1": 0.001,
    "wedge_2": 0.001,
    "quartz_1": 1.0,
    "mgf2_1": 1.0,
    "quartz_2": 1.0,
    "mgf2_2": 1.0,
    "quartz_c": 1.0,
    "mgf2_c": 1.0,
    "eta_1": 0.0003,
    "eta_2": 0.0003,
    "coll": 0.003,
    "coll_q": 0.0015,
    "coll_u": 0.0015,
}

DEGREE = 4
TERMS = [(total - j, j) for total in range(DEGREE + 1) for j in range(total + 1)]
"""Degrees in x and y of each throughput coefficient: (0,0), (1,0), (0,1), (2,0), (1,1), (0,2), …"""

SCALE = 0.3
"""Field coordinate (deg) at which the argument of the Legendre polynomials is one."""

EXTINCTION = 2e-5
OPTICS = (
    "magnification",
    "distortion",
    "wedge_1",
    "wedge_2",
    "quartz_1",
    "mgf2_1",
    "quartz_2",
    "mgf2_2",
    "quartz_c",
    "mgf2_c",
)


def nominal(sources=0):
    """The nominal parameters, flat throughputs of one half, and unpolarised standards."""
    throughput = np.zeros((4, len(TERMS)))
    throughput[:, 0] = 0.5
    return {**NOMINAL, "throughput": throughput, "q": np.zeros(sources), "u": np.zeros(sources)}


# Materials --------------------------------------------------------------------------------------------


def _sellmeier(wavelength, constant, strengths, resonances):
    """n² = constant + Σ B λ² / (λ² − C), resonances C in µm²."""
    square = np.asarray(wavelength, float) ** 2
    return np.sqrt(
        constant + sum(b * square / (square - c) for b, c in zip(strengths, resonances, strict=True))
    )


def bk7(wavelength):
    """N-BK7, Schott 2017."""
    return _sellmeier(
        wavelength, 1.0, (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    )


def quartz(wavelength):
    """Ordinary and extraordinary index of crystal quartz, Ghosh 1999."""
    ordinary = _sellmeier(wavelength, 1.28604141, (1.07044083, 1.10202242), (0.0100585997, 100.0))
    extraordinary = _sellmeier(wavelength, 1.28851804, (1.09509924, 1.15662475), (0.0102101864, 100.0))
    return ordinary, extraordinary


def mgf2(wavelength):
    """Ordinary and extraordinary index of MgF2, Dodge 1984 (whose resonances are in µm, not µm²)."""
    ordinary = _sellmeier(
        wavelength, 1.0, (0.48755108, 0.39875031, 2.3120353), (0.04338408**2, 0.09461442**2, 23.793604**2)
    )
    extraordinary = _sellmeier(
        wavelength, 1.0, (0.41344023, 0.50497499, 2.4904862), (0.03684262**2, 0.09076162**2, 23.771995**2)
    )
    return ordinary, extraordinary


# Band -------------------------------------------------------------------------------------------------


def photon_spectrum(wavelength, teff):
    """Relative photon rate per wavelength of a black body; flat when `teff` is not a number."""
    wavelength = np.asarray(wavelength, float)
    if teff is None or not np.isfinite(teff):
        return np.ones_like(wavelength)
    return wavelength**-4 / np.expm1(14387.77 / (wavelength * teff))


def band(wavelength, throughput, teff):
    """The tabulated curve as a quadrature: the trapezoidal weight of every row, normalised to sum one."""
    wavelength = np.asarray(wavelength, float)
    throughput = np.asarray(throughput, float)
    good = np.isfinite(wavelength) & np.isfinite(throughput)
    wavelength, throughput = wavelength[good], throughput[good]
    if wavelength.size == 1:
        return wavelength, np.ones(1)
    step = np.empty_like(wavelength)
    step[1:-1] = (wavelength[2:] - wavelength[:-2]) / 2
    step[0], step[-1] = (wavelength[1] - wavelength[0]) / 2, (wavelength[-1] - wavelength[-2]) / 2
    weight = throughput * photon_spectrum(wavelength, teff) * step
    return wavelength, weight / weight.sum()


def gauss(wavelength, weight, nodes):
    """Gauss rule of `nodes` nodes for the discrete measure (wavelength, weight): Lanczos, Golub–Welsch."""
    if wavelength.size <= nodes:
        return wavelength, weight
    centre, half = (wavelength[0] + wavelength[-1]) / 2, (wavelength[-1] - wavelength[0]) / 2
    x = (wavelength - centre) / half
    vectors = np.zeros((nodes, x.size))
    vectors[0] = np.sqrt(weight / weight.sum())
    diagonal, side = np.zeros(nodes), np.zeros(nodes - 1)
    for i in range(nodes):
        v = x * vectors[i]
        diagonal[i] = v @ vectors[i]
        for _ in range(2):
            v = v - vectors[: i + 1].T @ (vectors[: i + 1] @ v)
        if i + 1 < nodes:
            side[i] = np.linalg.norm(v)
            vectors[i + 1] = v / side[i]
    t, basis = np.linalg.eigh(np.diag(diagonal) + np.diag(side, 1) + np.diag(side, -1))
    return centre + half * t, weight.sum() * basis[0] ** 2


# Geometry ---------------------------------------------------------------------------------------------


def pupil_direction(params, x, y):
    """Unit vectors (points, 3) in which the field points leave the collimator."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    stretch = 1 + params["distortion"] * (x**2 + y**2)
    angles = np.radians(params["magnification"] * np.stack([x * stretch, y * stretch], -1))
    k = np.concatenate([np.tan(angles), np.ones((*x.shape, 1))], -1)
    return k / np.linalg.norm(k, axis=-1, keepdims=True)


def refract(k, normal, n_before, n_after):
    """Snell's law for unit vectors, the surface `normal` along the way of the light."""
    n_before, n_after = np.asarray(n_before)[..., None], np.asarray(n_after)[..., None]
    cos_before = np.sum(k * normal, -1, keepdims=True)
    cos_after = np.sqrt(1 - (n_before / n_after) ** 2 * (1 - cos_before**2))
    return n_before / n_after * k + (cos_after - n_before / n_after * cos_before) * normal


def through_wedge(k, angle, wavelength):
    """Directions (points, wavelengths, 3) in air behind a BK7 wedge of front normal (sin w, 0, cos w)."""
    index = bk7(wavelength)
    front = np.array([np.sin(angle), 0.0, np.cos(angle)])
    inside = refract(k[:, None, :], front, np.ones_like(index), index)
    return refract(inside, np.array([0.0, 0.0, 1.0]), index, np.ones_like(index))


# Plates -----------------------------------------------------------------------------------------------


def _tangential(k, e):
    """(E_x, E_y, H_x, H_y) of a plane wave with wave vector `k` in units of the vacuum wave number."""
    h = np.cross(k, e)
    return np.concatenate([e[..., :2], h[..., :2]], -1)


def carried_axes(k):
    """The ICS axes X and Y carried from (0, 0, 1) to the direction `k` by the smallest rotation."""
    axes = []
    for j in (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])):
        along = (k @ j)[..., None]
        axes.append(j - along / (1 + k[..., 2:]) * (k + np.array([0.0, 0.0, 1.0])))
    return axes


def air_modes(k):
    """Tangential fields (…, 4, 2) of the two forward and two backward waves in air, and their k_z."""
    forward = [_tangential(k, e) for e in carried_axes(k)]
    flip = np.array([1.0, 1.0, -1.0])
    backward = [_tangential(k * flip, e * flip) for e in carried_axes(k)]
    kz = np.stack([k[..., 2], k[..., 2]], -1)
    return np.stack(forward, -1), np.stack(backward, -1), kz


def uniaxial_modes(k, n_o, n_e, axis):
    """As `air_modes` in a uniaxial crystal, optic axis in the surface at `axis` rad: ordinary, extraordinary.

    `k` is the direction in air: its tangential part is conserved.
    """
    c = np.array([np.cos(axis), np.sin(axis), 0.0])
    n_o, n_e = np.broadcast_arrays(n_o, n_e)
    n_o, n_e = np.broadcast_to(n_o, k.shape[:-1]), np.broadcast_to(n_e, k.shape[:-1])
    tangential = np.concatenate([k[..., :2], np.zeros_like(k[..., :1])], -1)
    along = tangential @ c
    across2 = np.sum(tangential**2, -1) - along**2
    # (k·c)² / n_o² + (|k|² − (k·c)²) / n_e² = 1 for the extraordinary wave
    kz_o = np.sqrt(n_o**2 - across2 - along**2)
    kz_e = np.sqrt(n_e**2 * (1 - along**2 / n_o**2) - across2)
    waves = []
    for sign in (1.0, -1.0):
        k_o, k_e = tangential.copy(), tangential.copy()
        k_o[..., 2], k_e[..., 2] = sign * kz_o, sign * kz_e
        e_o = np.cross(k_o, c)
        # the displacement lies in the plane of k and c, across k; E follows from the inverse permittivity
        d_e = np.cross(k_e, np.cross(k_e, c))
        d_c = (d_e @ c)[..., None] * c
        e_e = d_c / n_e[..., None] ** 2 + (d_e - d_c) / n_o[..., None] ** 2
        waves.append(np.stack([_tangential(k_o, e_o), _tangential(k_e, e_e)], -1))
    return waves[0], waves[1], np.stack([kz_o, kz_e], -1)


def cross_face(before, after):
    """Amplitudes (…, 2, 2) sent forward by one face: tangential E and H continuous, reflected waves dropped.

    Solves [after forward, −before backward] (t, r) = before forward.
    """
    matrix = np.concatenate([after[0], -before[1]], -1).astype(complex)
    return np.linalg.solve(matrix, before[0].astype(complex))[..., :2, :]


def plate_jones(k, wavelength, thickness_quartz, thickness_mgf2, axis):
    """Jones matrix (…, 2, 2) of quartz (optic axis at `axis` rad) and MgF2 (at `axis` + 90°) in contact.

    From and to the axes carried to `k`, whose last but one index runs along `wavelength` (µm).
    """
    air = air_modes(k)
    first = uniaxial_modes(k, *quartz(wavelength), axis)
    second = uniaxial_modes(k, *mgf2(wavelength), axis + np.pi / 2)
    wave_number = 2 * np.pi / np.asarray(wavelength)[..., None]
    step_1 = np.exp(1j * wave_number * thickness_quartz * first[2])[..., None]
    step_2 = np.exp(1j * wave_number * thickness_mgf2 * second[2])[..., None]
    jones = step_1 * cross_face(air, first)
    jones = step_2 * (cross_face(first, second) @ jones)
    return cross_face(second, air) @ jones


def mueller_rows(jones):
    """First two rows (…, 2, 4) of the Mueller matrix of a Jones matrix: the I and Q that come out."""
    rows = []
    for i in (0, 1):
        a, b = jones[..., i, 0], jones[..., i, 1]
        cross = a * b.conj()
        rows.append(
            np.stack(
                [
                    np.abs(a) ** 2 + np.abs(b) ** 2,
                    np.abs(a) ** 2 - np.abs(b) ** 2,
                    2 * cross.real,
                    2 * cross.imag,
                ],
                -1,
            )
            / 2
        )
    return np.stack([rows[0] + rows[1], rows[0] - rows[1]], -2)


# Instrument -------------------------------------------------------------------------------------------


def optics_rows(params, x, y, wavelength, chwp_angle=None):
    """Monochromatic I and Q behind each half-wave plate: (points, wavelengths, halves, 2, 4).

    From the Stokes parameters behind the collimator. `chwp_angle` in degrees, None when that plate is out.
    """
    x, y, wavelength = np.atleast_1d(x), np.atleast_1d(y), np.atleast_1d(wavelength)
    out = np.empty((x.size, wavelength.size, 2, 2, 4))
    chunk = max(1, 20000 // wavelength.size)
    for start in range(0, x.size, chunk):
        part = slice(start, start + chunk)
        k = pupil_direction(params, x[part], y[part])
        before = np.eye(2)
        if chwp_angle is not None and np.isfinite(chwp_angle):
            k_all = np.broadcast_to(k[:, None, :], (len(k), wavelength.size, 3))
            before = plate_jones(
                k_all, wavelength, params["quartz_c"], params["mgf2_c"], np.radians(chwp_angle)
            )
        for half, axis in ((1, 0.0), (2, np.radians(22.5))):
            behind = through_wedge(k, params[f"wedge_{half}"], wavelength)
            plate = plate_jones(behind, wavelength, params[f"quartz_{half}"], params[f"mgf2_{half}"], axis)
            out[part, :, half - 1] = mueller_rows(plate @ before)
    return out


def collimator(params, x, y):
    """Mueller matrices (points, 4, 4) of the non-depolarising linear diattenuator, mean transmission one."""
    x, y = np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float)
    radius2, phi = x**2 + y**2, np.arctan2(y, x)
    d = np.stack(
        [
            params["coll"] * radius2 * np.cos(2 * phi) + params["coll_q"],
            params["coll"] * radius2 * np.sin(2 * phi) + params["coll_u"],
            np.zeros_like(x),
        ],
        -1,
    )
    size2 = np.sum(d**2, -1)[:, None, None]
    root = np.sqrt(1 - size2)
    matrix = np.zeros((x.size, 4, 4))
    matrix[:, 0, 0] = 1
    matrix[:, 0, 1:] = matrix[:, 1:, 0] = d
    # (1 − √(1 − D²)) / D² = 1 / (1 + √(1 − D²))
    matrix[:, 1:, 1:] = root * np.eye(3) + d[:, :, None] * d[:, None, :] / (1 + root)
    return matrix


def legendre_basis(x, y, scale=SCALE):
    """The 15 products P_i(x / scale) P_j(y / scale) of `TERMS`, shape (points, 15)."""
    x, y = np.atleast_1d(x) / scale, np.atleast_1d(y) / scale
    one_d = [np.polynomial.legendre.legvander(v, DEGREE) for v in (x, y)]
    return np.stack([one_d[0][:, i] * one_d[1][:, j] for i, j in TERMS], -1)


def camera_throughput(params, x, y, scale=SCALE, log=False):
    """Throughput (points, 4): the Legendre series itself, or its exponential."""
    series = legendre_basis(x, y, scale) @ np.asarray(params["throughput"]).T
    return np.exp(series) if log else series


def cameras(params, x, y, rows, scale=SCALE, log=False):
    """Analysis vectors (points, 4, 4) from band-integrated I and Q rows (points, halves, 2, 4)."""
    efficiency = np.array([params["eta_1"], params["eta_2"]])[:, None]
    plus = (rows[:, :, 0] + efficiency * rows[:, :, 1]) / 2
    minus = (rows[:, :, 0] - efficiency * rows[:, :, 1]) / 2
    analysers = np.stack([plus[:, 0], minus[:, 0], plus[:, 1], minus[:, 1]], 1)
    return camera_throughput(params, x, y, scale, log)[..., None] * (analysers @ collimator(params, x, y))


def analysis_vectors(params, x, y, wavelengths, weights, chwp_angle=None, scale=SCALE, log=False):
    """Response (points, 4 cameras, 4) of the cameras to Stokes vectors on the sky, band integrated.

    `wavelengths` (µm) and `weights` are a quadrature, as `band` or `gauss` return it.
    """
    rows = np.einsum("w,pwhij->phij", weights, optics_rows(params, x, y, wavelengths, chwp_angle))
    return cameras(params, x, y, rows, scale, log)


def instrument_matrix(analysis):
    """m21, m22, m23, m31, m32, m33 (a dict of arrays) of analysis vectors (points, 4, 4)."""
    out = {}
    for row, (a, b) in ((2, (0, 1)), (3, (2, 3))):
        total = analysis[:, a, 0] + analysis[:, b, 0]
        for column in (1, 2, 3):
            out[f"m{row}{column}"] = (analysis[:, a, column - 1] - analysis[:, b, column - 1]) / total
    return out


def matrix(params, x, y, wavelengths, weights, chwp_angle=None, scale=SCALE, log=False):
    """The instrument matrix of the model: m21, m22, m23, m31, m32, m33."""
    return instrument_matrix(analysis_vectors(params, x, y, wavelengths, weights, chwp_angle, scale, log))


# Sources ----------------------------------------------------------------------------------------------


def moon_geometry(mjd, ra, dec, rotator, x, y, latitude, longitude, elevation):
    """Scattering angle (rad) and EVPA in the ICS (rad) of moonlight for one exposure at field points."""
    from astropy import units
    from astropy.coordinates import EarthLocation, get_body
    from astropy.time import Time
    from astropy.utils import iers

    site = EarthLocation.from_geodetic(longitude * units.deg, latitude * units.deg, elevation * units.m)
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("iers_degraded_accuracy", "ignore"):
        moon = get_body("moon", Time(mjd, format="mjd", scale="utc"), site, ephemeris="builtin")
    moon = _unit(moon.ra.rad, moon.dec.rad)
    ra, dec, angle = np.radians([ra, dec, rotator])
    centre = _unit(ra, dec)
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(centre, east)
    x, y = np.radians(np.atleast_1d(x)), np.radians(np.atleast_1d(y))
    offset_n = x * np.cos(angle) - y * np.sin(angle)
    offset_e = x * np.sin(angle) + y * np.cos(angle)
    point = centre + offset_e[:, None] * east + offset_n[:, None] * north
    point /= np.linalg.norm(point, axis=-1, keepdims=True)
    gamma = np.arctan2(np.linalg.norm(np.cross(point, moon), axis=-1), point @ moon)
    # direction to the Moon in the sky at the point, carried back to the centre along the great circle
    # (the smallest rotation), so that its position angle refers to north at the centre
    toward = moon - (point @ moon)[:, None] * point
    toward = toward - (toward @ centre / (1 + point @ centre))[:, None] * (point + centre)
    position_angle = np.arctan2(toward @ east, toward @ north)
    return gamma, position_angle + np.pi / 2 - angle


def _unit(ra, dec):
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def rayleigh(gamma):
    """Degree of polarisation of single Rayleigh scattering, for a maximum of one."""
    return np.sin(gamma) ** 2 / (1 + np.cos(gamma) ** 2)


def polariser_state(angle):
    """Stokes vectors (…, 4) behind the polariser at `angle` degrees in the ICS."""
    contrast = (1 - EXTINCTION) / (1 + EXTINCTION)
    two = 2 * np.radians(np.asarray(angle, float))
    return np.stack(
        [np.ones_like(two), contrast * np.cos(two), contrast * np.sin(two), np.zeros_like(two)], -1
    )


# Calibration set --------------------------------------------------------------------------------------


def load(path):
    """A calibration set of tables as a dict of arrays, one entry per used row of intensities."""
    from astropy.io import fits

    with fits.open(path) as hdus:
        header = hdus[0].header
        tables = {
            hdu.name: {name: np.array(hdu.data[name]) for name in hdu.columns.names}
            for hdu in hdus[1:]
            if isinstance(hdu, fits.BinTableHDU)
        }
    exposures, points, rows = tables["EXPOSURES"], tables["POINTS"], tables["INTENSITIES"]
    used = rows["FLAG"] == 0
    rows = {name: value[used] for name, value in rows.items()}
    at_exposure = {number: i for i, number in enumerate(exposures["EXPOSURE"])}
    at_point = {number: i for i, number in enumerate(points["POINT"])}
    exposure = np.array([at_exposure[n] for n in rows["EXPOSURE"]])
    point = np.array([at_point[n] for n in rows["POINT"]])
    data = {
        "site": (float(header["SITELAT"]), float(header["SITELONG"]), float(header["SITEELEV"])),
        "x": points["X"].astype(float),
        "y": points["Y"].astype(float),
        "point": point,
        "exposure": exposure,
        "n": rows["N"].astype(float),
        "n_err": rows["N_ERR"].astype(float),
        "source": np.full(point.size, -1),
        "kind": np.char.strip(exposures["KIND"][exposure].astype(str)),
        "clp_in": exposures["CLP_IN"][exposure].astype(bool),
        "clp_angle": exposures["CLP_ANGLE"][exposure].astype(float),
        "rotator": exposures["ROTATOR"][exposure].astype(float),
        "filters": {},
        "sources": None,
    }
    for i, name in enumerate(tables.get("FILTERS", {}).get("FILTER", [])):
        curve = (tables["FILTERS"]["WAVELENGTH"][i], tables["FILTERS"]["THROUGHPUT"][i])
        data["filters"][str(name).strip()] = tuple(np.atleast_1d(v).astype(float) for v in curve)
    teff = exposures["TEFF"][exposure].astype(float)
    if "SOURCES" in tables:
        sources = tables["SOURCES"]
        data["sources"] = {key: sources[key].astype(float) for key in ("Q", "U", "Q_ERR", "U_ERR", "TEFF")}
        at_source = {number: i for i, number in enumerate(sources["SOURCE"])}
        data["source"] = np.array([at_source.get(n, -1) for n in rows["SOURCE"]])
        known = data["source"] >= 0
        own = np.where(known, data["sources"]["TEFF"][data["source"]], np.nan)
        teff = np.where(np.isfinite(own), own, teff)
    # polarisation of the Moon sky for delta = 1
    data["moon_q"], data["moon_u"] = np.zeros(point.size), np.zeros(point.size)
    for i in np.unique(exposure[data["kind"] == "moon"]):
        here = exposure == i
        pointing = (exposures[name][i] for name in ("MJD", "RA", "DEC", "ROTATOR"))
        gamma, evpa = moon_geometry(*pointing, data["x"][point[here]], data["y"][point[here]], *data["site"])
        data["moon_q"][here] = rayleigh(gamma) * np.cos(2 * evpa)
        data["moon_u"][here] = rayleigh(gamma) * np.sin(2 * evpa)
    # one configuration per (filter, colour temperature, calibration plate)
    chwp = np.where(exposures["CHWP_IN"], exposures["CHWP_ANGLE"], np.nan)[exposure]
    filters = np.char.strip(exposures["FILTER"][exposure].astype(str))
    keys = [
        (f, None if np.isnan(t) else float(t), None if np.isnan(c) else float(c))
        for f, t, c in zip(filters, teff, chwp, strict=True)
    ]
    data["configurations"] = list(dict.fromkeys(keys))
    number = {key: i for i, key in enumerate(data["configurations"])}
    data["configuration"] = np.array([number[key] for key in keys])
    return data


def source_states(params, data):
    """Stokes vector (rows, 4) of every row of intensities, in the ICS, before the collimator."""
    state = np.zeros((data["point"].size, 4))
    state[:, 0] = 1
    moon = data["kind"] == "moon"
    state[moon, 1] = params["delta"] * data["moon_q"][moon]
    state[moon, 2] = params["delta"] * data["moon_u"][moon]
    standard = (data["source"] >= 0) & ~np.isnan(data["rotator"])
    q, u = (np.asarray(params[name])[data["source"][standard]] for name in ("q", "u"))
    two = 2 * np.radians(data["rotator"][standard])
    state[standard, 1] = q * np.cos(two) + u * np.sin(two)
    state[standard, 2] = u * np.cos(two) - q * np.sin(two)
    state[data["clp_in"]] = polariser_state(data["clp_angle"][data["clp_in"]])
    return state


def _band_rows(params, data, nodes):
    """I and Q rows of every (configuration, point) in the data, kept while the optics stay the same."""
    key = (nodes, *(float(params[name]) for name in OPTICS))
    cache = data.setdefault("cache", {})
    if cache.get("key") == key:
        return cache["rows"]
    out = np.zeros((len(data["configurations"]), data["x"].size, 2, 2, 4))
    for filter_name, plate in dict.fromkeys((f, c) for f, _, c in data["configurations"]):
        alike = [i for i, (f, _, c) in enumerate(data["configurations"]) if (f, c) == (filter_name, plate)]
        points = np.unique(data["point"][np.isin(data["configuration"], alike)])
        curve = data["filters"][filter_name]
        if nodes is None:
            wavelength = band(*curve, None)[0]
        else:
            wavelength, weight = gauss(*band(*curve, 6000.0), nodes)
            weight = weight / photon_spectrum(wavelength, 6000.0)
        rows = optics_rows(params, data["x"][points], data["y"][points], wavelength, plate)
        for i in alike:
            teff = data["configurations"][i][1]
            if nodes is None:
                w = band(*curve, teff)[1]
            else:
                w = weight * photon_spectrum(wavelength, teff)
                w = w / w.sum()
            out[i, points] = np.einsum("w,pwhij->phij", w, rows)
    data["cache"] = {"key": key, "rows": out}
    return out


def model_counts(params, data, nodes=None, scale=SCALE, log=False):
    """Counts (rows, 4) for unit flux of every row. `nodes`: None for the whole table, or a Gauss rule."""
    rows = _band_rows(params, data, nodes)
    x, y, point = data["x"], data["y"], data["point"]
    analysis = np.stack([cameras(params, x, y, r, scale, log) for r in rows])
    return np.einsum("rki,ri->rk", analysis[data["configuration"], point], source_states(params, data))


def residuals(params, data, nodes=None, scale=SCALE, log=False):
    """Normalised residuals: four per row, its flux eliminated by weighted projection, then the priors."""
    model = model_counts(params, data, nodes, scale, log) / data["n_err"]
    measured = data["n"] / data["n_err"]
    flux = np.sum(model * measured, -1) / np.sum(model * model, -1)
    flux = np.where(data["kind"] == "flux", 1.0, flux)
    parts = [(measured - flux[:, None] * model).ravel()]
    parts.append(np.array([(params[k] - NOMINAL[k]) / width for k, width in PRIOR_WIDTH.items()]))
    if data["sources"] is not None:
        catalogue = data["sources"]
        parts.append((np.asarray(params["q"]) - catalogue["Q"]) / catalogue["Q_ERR"])
        parts.append((np.asarray(params["u"]) - catalogue["U"]) / catalogue["U_ERR"])
    return np.concatenate(parts)
