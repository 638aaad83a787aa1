"""Which piece of a mosaic is the first that does not fit."""

from __future__ import annotations

import pytest

from ladarreg_core.acquisition.composition.piece_fit import Overlaps, PieceFit

COLUMNS, PIECES = 4, 12
CELLS = 1000


def fit_of(elsewhere: set[int], *, rate: float = 0.004, wrong: float = 0.3) -> PieceFit:
    """Return the fit of a mosaic of three rows, of whose pieces some lie elsewhere, all by the same angle."""
    overlaps = Overlaps()
    for first in range(PIECES):
        for second in range(first + 1, PIECES):
            across = abs(first // COLUMNS - second // COLUMNS), abs(first % COLUMNS - second % COLUMNS)
            if max(across) > 1:
                continue
            share = wrong if (first in elsewhere) != (second in elsewhere) else rate
            overlaps.add([(first, second, CELLS, round(share * CELLS))])
    return overlaps.fit(PIECES)


def test_a_right_mosaic_fits() -> None:
    fit = fit_of(set())
    assert fit.fits
    assert fit.first_misfit is None
    assert fit.share == pytest.approx(0.004)


@pytest.mark.parametrize("first", [2, 3, 5, 8, 10])
def test_the_first_of_those_that_lie_elsewhere_is_found(first: int) -> None:
    fit = fit_of({*range(first, PIECES)})
    assert not fit.fits
    assert (fit.first_misfit, fit.alone) == (first, False)
    assert f"from piece {first} on" in fit.sentence(first)


@pytest.mark.parametrize("one", [0, 4, 6, 11])
def test_a_piece_that_lies_elsewhere_alone_is_found(one: int) -> None:
    fit = fit_of({one}, wrong=0.6)
    assert (fit.first_misfit, fit.alone) == (one, True)
    assert f"piece {one} lies elsewhere" in fit.sentence(one)


def test_more_faults_than_one_are_said() -> None:
    fit = fit_of({*range(6, PIECES)}, rate=0.2, wrong=0.8)
    assert fit.first_misfit == 6
    assert "20% of the others disagree, too" in fit.sentence(6)


def test_one_piece_among_many_is_found() -> None:
    """Too few of all cells disagree, but all of one piece."""
    overlaps = Overlaps()
    for first in range(200):
        overlaps.add([(first, first + 1, CELLS, CELLS if 140 in (first, first + 1) else 3)])
    fit = overlaps.fit(201)
    assert fit.share < 0.05
    assert (fit.fits, fit.first_misfit, fit.alone) == (False, 140, True)


def test_a_few_cells_decide_nothing() -> None:
    overlaps = Overlaps()
    overlaps.add([(0, 1, 150, 150)])
    assert overlaps.fit(2).fits
    assert Overlaps().fit(0).fits
