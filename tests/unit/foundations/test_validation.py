"""Checks of arguments: what passes, what is refused, and in which words."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import CameraError, LadarregError, OptionError
from ladarreg_core.foundations.validation import (
    LARGEST_INT,
    require_choice,
    require_int,
    require_number,
    require_positive,
    require_type,
)


def refusal(check: Any, *args: object, **options: object) -> str:
    """Return the text of the error that a check raises."""
    with pytest.raises(LadarregError) as caught:
        check(*args, **options)
    return str(caught.value)


def test_choices() -> None:
    require_choice("ends", ("ends", "equal"), "the use of lines")
    require_choice(None, (None, "both"), "the channels")
    assert refusal(require_choice, "mean", ("ends", "equal"), "the use of lines") == (
        "the use of lines is 'mean'; it must be one of ends, equal"
    )
    for other in (None, 1, True, ["ends"], np.array(["ends"])):
        assert "it must be one of" in refusal(require_choice, other, ("ends", "equal"), "the use of lines")
    assert "one of" in refusal(require_choice, True, (1, 2), "the level")


def test_whole_numbers() -> None:
    assert require_int(3, "n", least=0) == 3
    assert type(require_int(np.int16(3), "n", least=0, most=3)) is int
    assert refusal(require_int, -1, "the seed", least=0) == "the seed is -1; it must be a whole number of at least 0"
    assert refusal(require_int, 0, "the step", least=1, unit="cells") == (
        "the step is 0; it must be a whole number of cells, at least 1"
    )
    assert refusal(require_int, 2**31, "the seed", least=0, most=LARGEST_INT).endswith("from 0 to 2,147,483,647")
    for other in (True, 1.0, "1", None, np.float32(1), np.nan):
        assert "whole number" in refusal(require_int, other, "n", least=0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, True, "1", None, 1j, 10**400, [1.0]])
def test_what_is_no_number(value: object) -> None:
    assert "finite number" in refusal(require_number, value, "x")
    assert "number of metres, at least 0" in refusal(require_number, value, "x", least=0, unit="metres")
    assert "positive number" in refusal(require_positive, value, "x")


def test_numbers() -> None:
    assert type(require_number(np.float32(0.5), "x", least=0, most=1)) is float
    assert require_number(-7, "x") == -7
    assert require_positive(1e-12, "x", most=1) == 1e-12
    assert refusal(require_number, 1.5, "the share", least=0, most=1) == (
        "the share is 1.5; it must be a number from 0 to 1"
    )
    assert refusal(require_positive, np.float64(0.0), "sigma_px", unit="pixels") == (
        "sigma_px is 0.0; it must be a positive number of pixels"
    )
    assert refusal(require_positive, 5, "gamma", most=4).endswith("a positive number, at most 4")


def test_types() -> None:
    assert require_type(3, int, "the count") == 3
    assert refusal(require_type, "a path", int, "the count") == "the count is a str; give an int"


def test_the_error_and_the_length_of_what_is_shown() -> None:
    with pytest.raises(CameraError):
        require_type(None, int, "the camera", error=CameraError)
    with pytest.raises(OptionError, match=r"x{50}\.\.\.; it must") as caught:
        require_int("x" * 10_000, "n", least=0)
    assert len(str(caught.value)) < 200
