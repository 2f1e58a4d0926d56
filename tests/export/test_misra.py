"""The deviations of the C core from MISRA C:2012 are those of the manual, each with its reason."""

from __future__ import annotations

from pathlib import Path

import pytest
from export import misra
from export.test_folders import two_mass, write

from taciturn_export.folder import print_folder


def test_every_deviation_has_a_reason() -> None:
    """In a sentence, with the category of its rule and a number for at least one version of cppcheck."""
    kept = misra.table()
    for rule, row in kept["rules"].items():
        assert row["reason"].endswith("."), rule
        assert row["category"] in ("advisory", "required"), rule
        assert 0 < len(row["found"]) <= len(kept["versions"])
        assert set(row["found"]) <= set(kept["versions"])
        assert all(number > 0 for number in row["found"].values())


@pytest.mark.evidence
def test_the_deviations_are_those_of_the_table() -> None:
    """Rule by rule; a new one fails, and one that is gone too."""
    checked = _known_version()
    assert misra.counts(misra.core_places()) == misra.of_version(misra.table(), checked)


@pytest.mark.evidence
def test_a_planted_deviation_is_found(tmp_path: Path) -> None:
    """An octal number, which none of the rules of the table allows."""
    checked = _known_version()
    folder = write(tmp_path, print_folder(two_mass(), "two_mass", rows=1))
    source = folder / "taciturn_outbox.c"
    text = source.read_text(encoding="ascii")
    assert text.count("packet.entries = 0U;") == 1
    source.write_text(text.replace("packet.entries = 0U;", "packet.entries = 00;", 1), encoding="ascii")
    new = set(misra.counts(misra.places(folder, [source.name]))) - set(misra.of_version(misra.table(), checked))
    assert "7.1" in new


def _known_version() -> str:
    checked = misra.version()
    if checked is None:
        pytest.skip("NOT SHOWN: deviations from MISRA C:2012; there is no cppcheck")
    if checked not in misra.table()["versions"]:
        known = " and ".join(misra.table()["versions"])
        pytest.skip(f"NOT SHOWN: deviations from MISRA C:2012; cppcheck is {checked}, and the table is of {known}")
    return checked
