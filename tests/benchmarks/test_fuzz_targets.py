"""The targets of the fuzzer: inputs that depend on their number alone, and what once broke stays mended."""

import sys
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from benchmarks.fuzzing.campaign import TARGETS as REGISTRY
from benchmarks.fuzzing.campaign import Campaign, _Pool, divided
from benchmarks.fuzzing.cases import Case, num_edits
from benchmarks.fuzzing.findings import stored_cases
from benchmarks.fuzzing.mutation.files import edited_file
from benchmarks.fuzzing.targets.registry import TARGETS

STORED = list(stored_cases(Path(__file__).resolve().parents[1] / "data" / "fuzz"))
LEAST_ACCEPTED = 0.03  # of the first inputs of a target: mutators that only make noise reach no code behind the parsers

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are watched on Linux")


@pytest.fixture(scope="module")
def readers() -> Iterator[_Pool]:
    with _Pool(1, REGISTRY, 0) as pool:
        yield pool


def test_every_target_has_its_part_of_a_million() -> None:
    parts = divided(1_000_000, {name: target.share for name, target in TARGETS.items()})
    assert sum(parts.values()) == 1_000_000
    assert min(parts.values()) >= 5000, "inputs of the slowest targets"
    assert parts == {name: 1000 * target.share for name, target in TARGETS.items()}, "shares are thousands of a million"


@pytest.mark.parametrize("name", TARGETS)
def test_an_input_depends_on_its_number_alone(name: str) -> None:
    target = TARGETS[name]
    first, again = (target.case(0, 3) for _ in range(2))
    assert first == again
    bases = target.bases
    cases = [target.case(0, number) for number in range(20)]
    assert any(case.content != bases[case.base].files[case.path] for case in cases)
    assert target.case(0, 3, kept=()).content == bases[first.base].files[first.path]
    assert 1 <= num_edits(0, target, 3) <= 5
    assert len({case.content for case in cases}) > 5


def test_edits_of_every_form_give_bytes() -> None:
    for target in TARGETS.values():
        for base in target.bases.values():
            for path in base.changed or base.files:
                for number in range(3):
                    content = edited_file(path, base.files[path], Random(number), (), target.words)  # noqa: S311 - inputs
                    edited_file(path, content, Random(number + 1), (content,), target.words)  # noqa: S311 - inputs


def test_weights_whose_header_an_edit_has_emptied_are_edited_again() -> None:
    for number in range(200):
        edited_file("a.safetensors", bytes(8), Random(number), (), ())  # noqa: S311 - inputs


@pytest.mark.parametrize(("target", "name", "case"), STORED, ids=[f"{target}-{name}" for target, name, _ in STORED])
def test_what_once_broke_stays_mended(readers: _Pool, target: str, name: str, case: Case) -> None:
    finding = readers.replay(target, case).finding
    assert finding is None, f"{finding.key}\n{finding.message}\n{finding.trace}"


@pytest.mark.parametrize(("target", "path"), [("run_publish", "manifest.json"), ("run_join", "first/manifest.json")])
def test_runs_are_published_and_joined(readers: _Pool, target: str, path: str) -> None:
    for base in TARGETS[target].bases.values():
        assert readers.replay(target, Case(base.name, path, base.files[path])).is_accepted
    shard = next(name for name in base.changed if "scenes/" in name)
    outcome = readers.replay(target, Case(base.name, shard, b"no table"))
    assert (outcome.is_accepted, outcome.finding) == (False, None)
    assert outcome.code


def test_every_stored_input_belongs_to_a_target() -> None:
    assert STORED
    for target, _, case in STORED:
        assert case.path in TARGETS[target].bases[case.base].files
        assert len(case.content) < 100_000


@pytest.mark.slow
def test_inputs_of_every_target_are_accepted_often_enough(tmp_path: Path) -> None:
    campaign = Campaign(tmp_path, 0, 1)
    for name in TARGETS:
        campaign.plan(60, [name])
    campaign.run()
    shares = {name: counts.accepted / counts.done for name, counts in campaign.state.targets.items()}
    assert {name: share for name, share in shares.items() if share < LEAST_ACCEPTED} == {}
    assert campaign.state.findings == {}
