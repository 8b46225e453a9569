"""Numbers with errors as a reader expects them, typed by hand."""

from __future__ import annotations

import pytest

from walop_jax.io.text import (
    beside,
    in_its_unit,
    per_cent,
    per_cent_range,
    probability,
    two_digits_range,
    with_error,
)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.232268, 0.000241, "0.23227 ± 0.00024"),
        (-3.14159, 0.0996, "−3.14 ± 0.10"),
        (12345.6, 78.9, "12346 ± 79"),
        (12345.6, 789.0, "12350 ± 790"),
        (1.0, 0.15, "1.00 ± 0.15"),
        (2.5e-12, 1e-13, "2.50e-12 ± 1.0e-13"),
        (4.0, 0.0, "4"),
    ],
)
def test_the_error_has_two_digits_and_the_value_ends_where_it_does(value, sigma, text):
    assert with_error(value, sigma) == text


def test_probabilities_and_ranges():
    assert [probability(p) for p in (0.4321, 2.14e-7, 1e-16)] == ["= 0.43", "= 2.1 × 10⁻⁷", "< 10⁻¹⁵"]
    assert two_digits_range(0.4, 2.04) == "0.40 … 2.0"
    assert two_digits_range(0.4, 0.41) == "0.40"


@pytest.mark.parametrize(
    ("value", "limit", "texts"),
    [
        (0.083, 0.05, ("0.083", "0.050")),
        (0.0503, 0.05, ("0.0503", "0.050")),
        (0.04999, 0.05, ("0.04999", "0.050")),
        (0.05000004, 0.05, ("0.05000004", "0.050")),
        (0.05, 0.05, ("0.050", "0.050")),
        (0.06149, 0.0615, ("0.06149", "0.06150")),  # two digits do not say this limit
        (-0.0503, -0.05, ("−0.0503", "−0.050")),
        (float("nan"), 0.05, ("–", "0.050")),
    ],
)
def test_a_number_beside_its_limit_shows_on_which_side_it_lies(value, limit, texts):
    assert beside(value, limit) == texts


def test_rounding_noise_is_no_result():
    """Effects on q, u or p below 10⁻⁸ are noise of float64 optics; in per cent 10⁻⁶."""
    assert [per_cent(share) for share in (0.0023, 1.2e-7, 4.5e-19, 0.0)] == [
        "0.23",
        "1.2e-05",
        "< 10⁻⁶",
        "0.0",
    ]
    assert per_cent_range(4.5e-19, 4.2e-18) == "< 10⁻⁶"
    assert per_cent_range(4.5e-19, 0.0019) == "< 10⁻⁶ … 0.19"
    assert per_cent_range(0.0016, 0.0019) == "0.16 … 0.19"
    assert per_cent_range(0.0, 0.0) == "0"
    assert per_cent_range(float("nan"), 1.0) == ""


def test_a_missing_unit_leaves_no_blank():
    assert [in_its_unit("0.5", unit) for unit in ("um", "")] == ["0.5 um", "0.5"]
