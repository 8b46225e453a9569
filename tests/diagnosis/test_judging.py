"""What a diagnosis weighs: evidence, consequences, limits, robust errors, and what stays without a name."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from matrix_at import matrix_at
from scenes import PLAN
from scipy import integrate, stats

from walop_jax.calibration.accuracy import largest_change
from walop_jax.data.records import Position
from walop_jax.diagnosis import exact, refits
from walop_jax.diagnosis.design import Design, Measured, strata
from walop_jax.diagnosis.examination import upper_limit
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_file import model_without_data
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.code import blank
from walop_jax.likelihood.columns import own_columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, FreeForm, effect_by_name
from walop_jax.model.effects.free_form import BLOCKS
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.simulation.observing_plan import polariser_turn
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def leaking():
    """A set with some leakage, its fit without and with that effect, and the context."""
    effect = effect_by_name("camera_leakage").of(PLAN.context(), share=4e-4)
    calset, _ = simulate(PLAN, seed=8, effects=[effect])
    model = base_model(calset)
    context = effect_context(model.template, calset.exposures)
    base = fit(Likelihood.of(calset, model))
    return calset, context, base, fit(Likelihood.of(calset, with_effects(model, ["camera_leakage"], context)))


def test_density_at_neutral_is_the_evidence_of_two_fits(leaking):
    """Savage–Dickey against Laplace evidence of the models with and without: both Gaussian, so alike."""
    _, _, base, extended = leaking
    by_fits = exact.log_evidence_ratio(base, extended)
    assert by_fits > 5.0
    assert exact.evidence_of_presence(extended, "camera_leakage") == pytest.approx(by_fits, abs=0.5)


@pytest.mark.parametrize(
    ("mean", "width", "measured", "error"), [(0.0, 1e-3, 4e-4, 2e-4), (2e-4, 3e-4, -1e-4, 5e-4)]
)
def test_evidence_of_one_number_is_an_integral_over_its_prior(mean, width, measured, error):
    """One amplitude measured as `measured` ± `error`, its prior `mean` ± `width`: ∫ p(data|a) p(a) da by quadrature."""
    model = with_effects(model_without_data(nominal_instrument()), ["camera_leakage"], PLAN.context())
    model = model.change("camera_leakage.share", prior=(mean, width))
    at = model.index("camera_leakage.share")
    values, covariance = model.start.copy(), np.eye(len(model.start))
    covariance[at, at] = 1.0 / (error**-2 + width**-2)
    values[at] = covariance[at, at] * (measured / error**2 + mean / width**2)
    result = blank(FitResult)
    vars(result).update(likelihood=SimpleNamespace(model=model), values=values, covariance=covariance)
    found = exact.evidence_of_presence(result, "camera_leakage")
    prior, data = stats.norm(mean, width).pdf, stats.norm(measured, error).pdf
    there = integrate.quad(lambda a: prior(a) * data(a), mean - 9 * width, mean + 9 * width)[0]
    assert found == pytest.approx(np.log(there / data(mean)), abs=1e-6)


def test_evidence_of_many_numbers_is_the_mean_over_fits_with_priors_of_four_widths(leaking):
    """Moon patches of which each is small beside its prior: fits at every width, their Laplace evidence by hand."""
    context, rng = leaking[1], np.random.default_rng(1)
    neutral = effect_by_name("moon_patch").neutral(context)
    q, u = 5e-4 * rng.standard_normal((2, len(neutral.q)))
    calset, _ = simulate(PLAN, seed=8, effects=[neutral.replaced(q=q, u=u)])
    model = base_model(calset)
    base = fit(Likelihood.of(calset, model))
    with_patches, evidence = with_effects(model, ["moon_patch"], context), []
    added = [name for name in with_patches.names if name.startswith("moon_patch.")]
    for scale in (1.0, 0.3, 0.1, 0.03):
        narrower = with_patches
        for name in added:
            narrower = narrower.change(name, prior=(0.0, scale * 0.005))
        found = fit(Likelihood.of(calset, narrower))
        curvature = [np.linalg.slogdet(one.expansion.matrix)[1] for one in (base, found)]
        gain = base.expansion.objective - found.expansion.objective - (curvature[1] - curvature[0])
        evidence.append(0.5 * gain - len(added) * np.log(scale * 0.005))
    extended = fit(Likelihood.of(calset, with_patches))
    mean = np.logaddexp.reduce(evidence) - np.log(4.0)
    assert exact.log_evidence_ratio(base, extended) == pytest.approx(mean, abs=0.05)
    assert exact.evidence_of_presence(extended, "moon_patch") == pytest.approx(mean, abs=0.05)
    assert mean > evidence[0] + 5.0


def test_signature_is_what_taking_the_effect_away_does(leaking):
    """To first order, the effect's column times its amplitude."""
    calset, context, base, extended = leaking
    probe = effect_by_name("camera_leakage").probes(context)[0]
    bare = Likelihood.of(calset, base.model)
    kept = [extended.model.index(name) for name in base.model.names]
    column = own_columns(bare, extended.values[kept], probe)[:, 0]
    share, _ = extended.value("camera_leakage.share")
    found = exact.signature(extended, "camera_leakage")
    np.testing.assert_allclose(found, -column * share, atol=2e-2 * np.abs(found).max())


def test_taking_it_out_again_gives_the_fit_without(leaking):
    _, _, base, extended = leaking
    again = exact.refit_without(extended, "camera_leakage")
    assert again.model.names == base.model.names
    assert again.chi2 == pytest.approx(base.chi2, abs=1e-3)


def test_a_prior_is_widened_only_where_the_data_refute_it(leaking):
    *_, extended = leaking
    model, at = extended.model, extended.model.index("camera_leakage.share")
    mean, width = model.parameters[at].prior
    for away, expected in ((3.9, width), (-3.9, width), (12.0, 12.0 * width), (-12.0, 12.0 * width)):
        values = extended.values.copy()
        values[at] = mean + away * width
        wide = exact.with_refuted_priors_widened(model, values, "camera_leakage")
        assert wide["camera_leakage.share"].prior == (mean, pytest.approx(expected))
        assert wide.change("camera_leakage.share", prior=(mean, width)) == model
        widened = dataclasses.replace(extended.likelihood, model=wide)
        beyond = exact.beyond_prior(
            dataclasses.replace(extended, likelihood=widened, values=values), "camera_leakage"
        )
        assert beyond == ({"share": pytest.approx(12.0)} if abs(away) > 4.0 else {})


def test_robust_errors_are_the_stated_ones_when_noise_is_as_stated(leaking):
    design = Design.of(leaking[-1])
    assert 0.6 < design.robust_ratio("camera_leakage") < 1.5
    assert np.isnan(design.robust_ratio("ghost"))


def test_robust_errors_see_disturbances_of_whole_exposures(leaking):
    """Each exposure pulls the magnification by five times what noise lets it."""
    design = Design.of(leaking[-1])
    column = design.without(design.columns_of(design.fit.model.positions("pupil")))[1][: design.rows, 0]
    length = np.sqrt(np.bincount(design.exposure, column**2))
    pull = 5.0 * np.random.default_rng(4).choice([-1.0, 1.0], length.size) / length
    disturbed = design.residual.copy()
    disturbed[: design.rows] += pull[design.exposure] * column
    assert dataclasses.replace(design, residual=design.projector(disturbed)).robust_ratio("pupil") > 2.0


def test_patterns_do_not_know_the_noise(leaking):
    """Columns of two sets that differ by nothing but their noise differ by no more than their fits do."""
    calset, _, base, _ = leaking
    other, _ = simulate(
        PLAN,
        seed=8,
        effects=[effect_by_name("camera_leakage").of(PLAN.context(), share=4e-4)],
        noiseless=True,
    )
    ours, exact = (Measured(Likelihood.of(s, base.model), base.values).level for s in (calset, other))
    np.testing.assert_allclose(ours, exact, rtol=1e-12)


@pytest.mark.parametrize(("value", "sigma"), [(0.0, 1.0), (2.0, 0.5), (-1.5, 1.0)])
def test_limits_against_integrals(value, sigma):
    """95 % of a flat-prior posterior below the limit: of |a|, or of a > 0."""
    posterior = stats.norm(value, sigma).pdf
    two = upper_limit(value, sigma, one_sided=False)
    assert integrate.quad(posterior, -two, two)[0] == pytest.approx(0.95, abs=1e-6)
    one = upper_limit(value, sigma, one_sided=True)
    inside, whole = (integrate.quad(posterior, 0, end)[0] for end in (one, value + 12 * sigma))
    assert inside / whole == pytest.approx(0.95, abs=1e-6)


def test_change_of_stokes_by_hand():
    """An ideal instrument; a constant of 0.001 in q moves q by that, 1 % less efficiency moves 5 % by 0.05 %."""
    ideal = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    assert largest_change(ideal, ideal) == 0.0
    offset, weak = ideal.copy(), ideal.copy()
    offset[0, 0, 0] = 1e-3
    weak[0, 0, 1] = 0.99
    assert largest_change(ideal, offset) == pytest.approx(1e-3)
    assert largest_change(ideal, weak) == pytest.approx(5e-4)
    blind = np.array([[[0.0, 1.0, 0.0], [0.0, 1.0, 0.01]]])
    assert np.isnan(largest_change(blind, offset))


def test_every_block_of_the_free_form_term_answers_to_a_stratum(leaking):
    *_, extended = leaking
    measured = Measured(extended.likelihood, extended.values)
    blocks = {stratum.name: stratum.block for stratum in strata(measured)}
    assert set(blocks.values()) == {*BLOCKS, ""}
    assert blocks["4θ of O1"] == blocks["4θ of light on O1"] == "harmonics"
    assert (blocks["rings of E2"], blocks["rings of light on E2"]) == ("fine_gains", "fine")
    assert (blocks["gain by kind"], blocks["response by kind"]) == ("exposure_gains", "exposures")
    assert blocks["gain with flux"] == ""


def test_many_names_and_weak_errors_call_for_caution():
    def caution(*steps, far=None, ended=""):
        named = [SimpleNamespace(effect=name, robust_ratio=ratio, far=far or {}) for name, ratio in steps]
        after = SimpleNamespace(calset=SimpleNamespace(points=range(9)))
        known = SimpleNamespace(steps=named, after=after, points=9, ended=ended)
        return Diagnosis.caution.fget(known)

    assert caution() == caution(("a", 1.1), ("b", float("nan"))) == ""
    assert "ended after 20 minutes" in caution(ended="20 minutes")
    assert "3 names" in caution(*((name, 1.0) for name in "abc"))
    assert "errors of a" in caution(("a", 2.0))
    assert "a.angle (6 widths)" in caution(("a", 1.0), far={"angle": 6.1})


@pytest.mark.long
def test_what_has_no_name_stays_unexplained_and_is_carried_along():
    """Fine structure of one camera, nothing that the catalogue has: described, taken up, not named."""
    # Of all harmonics of four cameras 12 angles say too little to predict a 13th.
    plan = dataclasses.replace(PLAN, polariser_angles=polariser_turn(36))
    context = effect_context(base_model(simulate(plan, seed=1).calset).template, plan.exposures())
    rng = np.random.default_rng(2)
    pattern = FreeForm.of(context, blocks=("harmonics",))
    waves = np.zeros(pattern.harmonics.shape)
    waves[0, 2] = 4e-4 * rng.standard_normal(waves[0, 2].shape)  # four times the angle, camera O1
    calset, _ = simulate(plan, seed=5, effects=[dataclasses.replace(pattern, harmonics=waves)])
    found = diagnose(calset)
    assert found.verdict == "unexplained"
    assert "4θ of light on O1" in found.unexplained.description
    assert "harmonics" in found.unexplained.free_form
    assert found.unexplained.chi2_after < found.unexplained.chi2_before
    assert found.after.explains_data


def slipped(seed=1):
    """A set in which settings of the polariser are off by 0.05° to either side in turn: no name says that."""
    stated = np.array(PLAN.polariser_angles)
    true = stated + 0.05 * (-1.0) ** np.arange(len(stated))
    simulated = simulate(dataclasses.replace(PLAN, polariser_angles=tuple(true.tolist())), seed=seed)
    e = simulated.calset.exposures
    nearest = np.abs(e.clp_angle[:, None] - true).argmin(axis=1)
    angle = np.where(e.clp_in, stated[nearest], e.clp_angle)
    exposures = e.placed(CLP=Position.at(angle))
    return dataclasses.replace(simulated.calset, exposures=exposures)


def vectors(design):
    """All patterns that change analysis vectors smoothly over the field."""
    measured = design.measured
    return [measured.candidate(one) for one in strata(measured) if one.block == "vectors"]


@pytest.fixture(scope="module")
def slips():
    calset = slipped()
    return Design.of(fit(Likelihood.of(calset, base_model(calset))))


def test_patterns_that_hold_at_no_other_setting_do_not_predict_it(slips):
    """Errors of single settings are smooth over the field: they predict parts of it that they have not seen."""
    assert slips.fit.chi2 > 1.5 * slips.fit.dof
    assert not refits.predicts_unseen(slips, vectors(slips))


def gains(seed=3):
    """A set whose cameras have a gain of their own in every exposure, and the instrument that made it."""
    pattern = FreeForm.of(PLAN.context(), blocks=("exposures",))
    own = np.abs(1e-3 * np.random.default_rng(seed).standard_normal(pattern.exposures.shape))
    return simulate(PLAN, seed=seed, effects=[dataclasses.replace(pattern, exposures=own)])[:2]


@pytest.mark.parametrize("hidden", [pytest.param("slips", marks=pytest.mark.long), "gains"])
def test_a_term_is_useful_where_the_matrix_is_closer_to_the_truth_with_it(hidden, slips):
    """Gains of single exposures, for settings that slip and for gains: slips are only made probable by being broad."""
    calset, truth = (slips.fit.calset, simulate(PLAN, seed=1).truth) if hidden == "slips" else gains()
    model = base_model(calset)
    context = effect_context(model.template, calset.exposures)
    term = with_effects(model, [FreeForm.of(context, blocks=("exposures",))], context)
    before, after = (fit(Likelihood.of(calset, one)) for one in (model, term))
    true = matrix_at(truth, calset)
    off = [np.std(matrix_at(f.model.instrument(f.values), calset) - true) for f in (before, after)]
    assert off[1] < 0.5 * off[0] if hidden == "gains" else off[1] > 1.5 * off[0]
    design = Design.of(before)
    columns = [design.measured.candidate(one) for one in strata(design.measured) if one.block == "exposures"]
    assert refits.predicts_unseen(design, columns) == (hidden == "gains")


def test_patterns_of_the_optics_predict_settings_that_they_have_not_seen():
    hidden = Described.saying(["retardance u behind half1.plate * xy"], [0.02])
    calset = simulate(PLAN, seed=1, effects=[hidden]).calset
    optics = Design.of(fit(Likelihood.of(calset, base_model(calset))))
    assert refits.predicts_unseen(optics, vectors(optics))


def test_units_that_all_gain_are_no_chance_however_much_two_of_them_gain():
    """Gains of 5 and two of a thousand: by their mean they are less than 2 standard errors above 0."""
    rng = np.random.default_rng(2)
    gain = np.append(5.0 + rng.standard_normal(28), [900.0, 1100.0])
    assert gain.mean() < 2.0 * gain.std(ddof=1) / np.sqrt(len(gain))
    assert refits._gained(gain) > 4.5
    # Σ rank / √Σ rank² = √(3 n (n + 1) / (2 (2 n + 1))) where all are above 0.
    assert refits._gained(gain) == pytest.approx(np.sqrt(1.5 * 30 * 31 / 61))
    assert refits._gained(-gain) < 0.0
    noise = [refits._gained(rng.standard_normal(30)) for _ in range(2000)]
    assert np.mean(np.array(noise) > 2.0) < 0.05
