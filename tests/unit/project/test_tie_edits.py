"""Ties and lines in a project: what is kept, what is refused, what goes with a photograph, undo, and storage."""

from __future__ import annotations

from typing import Any

import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.drawn import ScanLineEntry
from ladarreg_core.project.edits import without_photo
from ladarreg_core.project.inverse import ChangedSinceError, restored
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.codec import decode_document, encode
from ladarreg_core.project.storage.delta import change_between, check_readable
from ladarreg_core.project.tie_edits import (
    with_line,
    with_line_as_ties,
    with_line_in,
    with_line_in_scan,
    with_tie,
    without_line_in,
    without_lines,
    without_ties,
)

_UV = [[10.5, 20], [30, 40.25]]


def _document() -> Document:
    photos = tuple(
        PhotoEntry(id=name, source=Source(path=f"{name}.jpg", name=f"{name}.jpg", size=1))
        for name in ("p1", "p2", "p3")
    )
    return Document(photos=photos)


def test_ties_are_numbered_and_removed() -> None:
    document, first = with_tie(_document(), ["p1", "p2"], _UV, 0.5)
    document, second = with_tie(document, ["p3", "p1"], _UV, 1)
    assert (first.id, first.photos, first.uv, first.sigma_px) == (
        "t1",
        ("p1", "p2"),
        ((10.5, 20.0), (30.0, 40.25)),
        0.5,
    )
    document = without_ties(document, ["t2"])
    document, third = with_tie(document, ["p2", "p3"], _UV, 1)
    assert [one.id for one in document.ties] == ["t1", "t3"]
    assert third.id != second.id


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"photos": ["p1", "p1"]}, "same photograph"),
        ({"photos": ["p1", "p9"]}, "no longer in the project"),
        ({"photos": ["p1"]}, "needs two"),
        ({"uv": [[1, 2]]}, "needs two"),
        ({"uv": [[1, 2], [3]]}, r"\[u, v\]"),
        ({"uv": [[1, 2], [3, float("nan")]]}, "no number"),
        ({"uv": [[1, 2], [3, 1e9]]}, "pick in the image"),
        ({"sigma_px": 0}, "must be positive"),
        ({"sigma_px": "1"}, "no number"),
    ],
)
def test_what_is_no_tie_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        with_tie(_document(), **({"photos": ["p1", "p2"], "uv": _UV, "sigma_px": 1.0} | changes))


def test_a_photograph_takes_its_ties_with_it_and_undo_brings_both_back() -> None:
    document, _ = with_tie(_document(), ["p1", "p2"], _UV, 1.0)
    document, kept = with_tie(document, ["p3", "p1"], _UV, 1.0)
    gone = without_photo(document, "p2")
    assert gone.ties == (kept,)
    assert restored(gone, document, gone) == document


def test_each_takes_back_its_own_tie() -> None:
    before = _document()
    one, _ = with_tie(before, ["p1", "p2"], _UV, 1.0)
    two, second = with_tie(one, ["p1", "p3"], _UV, 1.0)
    assert restored(two, before, one).ties == (second,)
    with pytest.raises(ChangedSinceError):
        restored(without_ties(two, ["t1"]), before, one)


def test_ties_are_stored_by_difference_and_damage_is_told() -> None:
    before, _ = with_tie(_document(), ["p1", "p2"], _UV, 1.0)
    after, _ = with_tie(without_ties(before, ["t1"]), ["p1", "p3"], _UV, 2.0)
    check_readable(before, after)
    assert set(change_between(before, after)["ties"]) == {"new", "gone"}
    data = encode(after)
    assert decode_document(data, {}.__getitem__) == after
    with pytest.raises(OptionError, match="standard deviation"):
        decode_document(data.replace(b'"sigma_px":2.0', b'"sigma_px":-2.0'), {}.__getitem__)


def test_lines_are_drawn_in_one_photograph_after_the_other_and_drawn_again() -> None:
    document, line = with_line(_document(), ["p1"], [_UV], 0.5)
    assert (line.id, line.photos, line.uv) == ("l1", ("p1",), (((10.5, 20.0), (30.0, 40.25)),))
    document = with_line_in(document, "l1", "p3", [[1, 2], [3, 40]])
    document = with_line_in(document, "l1", "p1", [[10, 20], [30, 41]])
    (line,) = document.lines
    assert line.photos == ("p1", "p3")
    assert line.uv == (((10.0, 20.0), (30.0, 41.0)), ((1.0, 2.0), (3.0, 40.0)))
    document, second = with_line(without_lines(document, ["l1"]), ["p1", "p2"], [_UV, _UV], 1.0)
    assert (document.lines, second.id) == ((second,), "l2")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"photos": []}, "each of its photographs once"),
        ({"photos": [], "uv": []}, "draw it in a picture or more"),
        ({"photos": ["p1", "p1"]}, "each of its photographs once"),
        ({"photos": ["p1", "p9"]}, "no longer in the project"),
        ({"uv": [_UV]}, "each of its photographs once"),
        ({"uv": [_UV, [[1, 2]]]}, "two ends in a photograph"),
        ({"uv": [_UV, [[1, 2], [3, "4"]]]}, "no number"),
        ({"uv": [_UV, [[1, 2], [3, 4]]]}, "shorter than 5 px"),
        ({"sigma_px": 0}, "must be positive"),
    ],
)
def test_what_is_no_line_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        with_line(_document(), **({"photos": ["p1", "p2"], "uv": [_UV, _UV], "sigma_px": 1.0} | changes))
    with pytest.raises(OptionError, match="the line is no longer in the project"):
        with_line_in(_document(), "l1", "p1", _UV)


def test_the_ends_of_a_line_become_two_ties_where_two_photographs_show_both() -> None:
    ends = [[[10, 20], [30, 40]], [[50, 60], [70, 80]]]
    document, line = with_line(_document(), ["p1", "p2"], ends, 0.5)
    found = with_line_as_ties(document, line.id)
    assert not found.lines
    assert [(one.photos, one.uv, one.sigma_px) for one in found.ties] == [
        (("p1", "p2"), ((10.0, 20.0), (50.0, 60.0)), 0.5),
        (("p1", "p2"), ((30.0, 40.0), (70.0, 80.0)), 0.5),
    ]
    back = restored(found, document, found)
    assert (back.ties, back.lines) == ((), document.lines)
    with pytest.raises(OptionError, match="drawn in 3 photographs; its ends are ties where exactly two show both"):
        with_line_as_ties(with_line_in(document, "l1", "p3", _UV), "l1")


def test_a_photograph_takes_its_part_of_lines_with_it() -> None:
    document, _ = with_line(_document(), ["p1", "p2", "p3"], [_UV, _UV, _UV], 1.0)
    document, _ = with_line(document, ["p2"], [_UV], 1.0)
    gone = without_photo(document, "p2")
    assert [one.photos for one in gone.lines] == [("p1", "p3")]
    assert restored(gone, document, gone) == document


def test_a_line_is_drawn_in_a_scan_moved_and_erased_from_one_picture_after_the_other() -> None:
    source = Source(path="hall.npz", name="hall.npz", size=1)
    shown = ScanLineEntry(source=source, xyz=((1.0, 2.0, 3.0), (1.0, 2.0, 4.0)), sigma_m=0.004)
    document, line = with_line_in_scan(_document(), None, shown, 0.5)
    assert (line.photos, line.in_scan, line.sigma_px) == ((), shown, 0.5)
    document = with_line_in(document, "l1", "p2", _UV)
    again = ScanLineEntry(source=source, xyz=((1.0, 2.0, 3.0), (1.0, 2.0, 5.0)), sigma_m=0.004)
    document, line = with_line_in_scan(document, "l1", again, 0.5)
    assert (line.photos, line.in_scan) == (("p2",), again)
    assert without_line_in(document, "l1", None).lines[0].photos == ("p2",)
    (left,) = without_line_in(document, "l1", "p2").lines
    assert (left.photos, left.uv, left.in_scan) == ((), (), again)
    assert without_photo(document, "p2").lines == (left,), "the scan shows it still"
    assert without_line_in(without_line_in(document, "l1", "p2"), "l1", None).lines == ()
    for photo in ("p1", "p9"):
        with pytest.raises(OptionError, match="not drawn in that photograph"):
            without_line_in(document, "l1", photo)
    with pytest.raises(OptionError, match="not drawn in a scan"):
        without_line_in(without_line_in(document, "l1", None), "l1", None)
    with pytest.raises(OptionError, match="in its scan is -1 m"):
        with_line_in_scan(document, "l1", ScanLineEntry(source=source, xyz=shown.xyz, sigma_m=-1.0), 1.0)


def test_lines_are_stored_by_difference_and_damage_is_told() -> None:
    source = Source(path="hall.npz", name="hall.npz", size=1)
    shown = ScanLineEntry(source=source, xyz=((1.0, 2.0, 3.0), (1.0, 2.0, 4.0)), sigma_m=0.004)
    before, _ = with_line(_document(), ["p1", "p2"], [_UV, _UV], 1.0, shown)
    after = with_line_in(before, "l1", "p3", _UV)
    check_readable(before, after)
    assert set(change_between(before, after)["lines"]["in"]["l1"]) == {"photos", "uv"}
    data = encode(after)
    assert decode_document(data, {}.__getitem__) == after
    with pytest.raises(OptionError, match="standard deviation"):
        decode_document(data.replace(b'"sigma_px":1.0', b'"sigma_px":-2.0'), {}.__getitem__)
