"""Numbers as text for people."""

import math

import pytest

from ladarreg_core.foundations.formatting import (
    format_angle,
    format_length,
    format_number,
    format_percent,
    format_pixels,
)


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.00123, "1.2 mm"), (0.0994, "99 mm"), (0.0996, "0.10 m"), (1.234, "1.23 m"), (120, "120.00 m"), (0, "0 mm")],
)
def test_lengths_change_unit_before_a_third_digit(metres: float, text: str) -> None:
    assert format_length(metres) == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.0123, "0.012"), (99.4, "99"), (99.6, "100"), (1234.5, "1234"), (-250.0, "-250")]
)
def test_numbers_are_never_in_powers_of_ten_above_one(value: float, text: str) -> None:
    assert format_number(value) == text


def test_units() -> None:
    assert format_angle(math.pi) == "180 deg"
    assert format_angle(math.radians(0.123)) == "0.12 deg"
    assert format_pixels(0.3456) == "0.35 px"
    assert format_percent(0.987) == "99 %"
