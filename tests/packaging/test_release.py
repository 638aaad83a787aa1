"""What a release changes: the version, and the changelog's sections."""

from __future__ import annotations

from datetime import date

import pytest

from testing.release import CHANGELOG, ReleaseError, cut_changelog, next_version

DAY = date(2027, 1, 31)


def test_what_is_unreleased_becomes_the_section_of_the_version() -> None:
    text = "# Changelog\n\n## Unreleased\n\n- Spikes are found.\n\n## 0.2.0 (2026-01-01)\n\n- First.\n"
    cut = cut_changelog(text, "0.3.0", DAY)
    assert cut.replace("\n\n## 0.3.0 (2027-01-31)\n", "\n", 1) == text
    assert cut.index("## Unreleased") < cut.index("## 0.3.0") < cut.index("Spikes") < cut.index("## 0.2.0")


def test_the_own_changelog_can_be_cut() -> None:
    text = CHANGELOG.read_text(encoding="utf-8")
    assert len(cut_changelog(text, "99.0.0", DAY)) == len(text) + len("\n## 99.0.0 (2027-01-31)\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [("# Changelog\n", "no section"), ("# C\n\n## Unreleased\n\n## 0.2.0\n\n- First.\n", "nothing stands under")],
)
def test_a_release_without_changes_is_refused(text: str, words: str) -> None:
    with pytest.raises(ReleaseError, match=words):
        cut_changelog(text, "0.3.0", DAY)


def test_versions_only_grow() -> None:
    assert next_version("0.9.0", "0.10.0") == "0.10.0"
    for wrong in ("0.9.0", "0.8.9", "1.0", "v1.0.0"):
        with pytest.raises(ReleaseError, match="version"):
            next_version("0.9.0", wrong)
