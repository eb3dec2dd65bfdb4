"""Which licence counts, and which assets are refused."""

import pytest

from stable_data.errors import MeshError
from stable_data.importers.conversion import PERMISSIVE
from stable_data.importers.conversion.licensing import Licence, judge_licence
from stable_data.importers.source import GivenLicence

MANIFEST_BY = GivenLicence("CC BY 4.0", "manifest")
FILE_CC0 = GivenLicence("CC0", "LICENSE.txt")
FILE_NC = GivenLicence("Attribution-NonCommercial 4.0 International", "LICENSE")
UNREAD = GivenLicence("see the author's page", "README")
RESTRICTED = GivenLicence("for research only", "README")


def test_the_strictest_of_several_allowed_licences_counts_with_a_warning() -> None:
    licence, notices = judge_licence("a", (FILE_CC0, MANIFEST_BY), "", PERMISSIVE)
    assert licence == Licence("CC-BY-4.0", "CC BY 4.0", "manifest")
    assert [n.code for n in notices] == ["licence_conflict"]
    assert "CC0-1.0 in LICENSE.txt" in notices[0].message


def test_equal_statements_are_no_conflict_and_the_most_specific_is_kept() -> None:
    licence, notices = judge_licence("a", (GivenLicence("cc-by-4.0", "manifest"), MANIFEST_BY), "CC BY 4.0", PERMISSIVE)
    assert (licence.text, notices) == ("cc-by-4.0", ())


@pytest.mark.parametrize(
    ("stated", "option", "code"),
    [
        ((), "", "licence_unknown"),
        ((UNREAD,), "", "licence_unknown"),
        ((), "a licence of my own", "licence_unknown"),
        ((FILE_NC,), "", "licence_refused"),
        ((GivenLicence("CC BY-SA 4.0", "manifest"),), "", "licence_refused"),
        ((GivenLicence("CC BY-ND 4.0", "manifest"),), "", "licence_refused"),
        ((MANIFEST_BY, FILE_NC), "", "licence_conflict"),
        ((MANIFEST_BY, RESTRICTED), "", "licence_conflict"),
        ((FILE_NC,), "CC0", "licence_conflict"),
    ],
)
def test_what_is_refused(stated: tuple[GivenLicence, ...], option: str, code: str) -> None:
    with pytest.raises(MeshError) as error:
        judge_licence("a", stated, option, PERMISSIVE)
    assert error.value.code == code
    assert "expected" in str(error.value) or "contradict" in str(error.value)


def test_the_option_states_what_a_source_leaves_open() -> None:
    assert judge_licence("a", (), "MIT-0", PERMISSIVE) == (Licence("MIT-0", "MIT-0", "option"), ())
    licence, notices = judge_licence("a", (UNREAD,), "MIT-0", PERMISSIVE)
    assert licence.where == "option"
    assert [n.code for n in notices] == ["licence_conflict"]


def test_a_licence_can_be_allowed() -> None:
    assert judge_licence("a", (FILE_NC,), "", (*PERMISSIVE, "CC BY-NC"))[0].name == "CC-BY-NC-4.0"
