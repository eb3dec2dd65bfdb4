"""The fuzzer finds what is planted, and a stopped campaign continues exactly."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.fuzz import main
from benchmarks.fuzzing.campaign import Campaign, State, _Pool, _Run, divided, remove_left_behind
from benchmarks.fuzzing.cases import Case
from benchmarks.fuzzing.findings import KnownFinding
from benchmarks.fuzzing.watching import Finding, FindingKind, Outcome
from tests.benchmarks.planted import HONEST

ROOT = Path(__file__).resolve().parents[2]
PLANTED = "tests.benchmarks.planted:TARGETS"

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are watched on Linux")


@pytest.fixture(scope="module")
def planted() -> Iterator[_Pool]:
    with _Pool(1, PLANTED, 0) as pool:
        yield pool


def said(pool: _Pool, word: str) -> Outcome:
    return pool.replay("planted", Case("honest", "text.txt", f"{HONEST.decode()} {word} end_of_text".encode()))


def found(pool: _Pool, word: str) -> Finding:
    finding = said(pool, word).finding
    assert finding is not None
    return finding


def test_honest_and_refused_inputs_are_no_findings(planted: _Pool) -> None:
    assert said(planted, "").is_accepted
    outcome = said(planted, "refused")
    assert (outcome.is_accepted, outcome.code, outcome.finding) == (False, "text_refused", None)


@pytest.mark.parametrize(
    ("word", "kind", "type_"),
    [
        ("crash", FindingKind.CRASH, "KeyError"),
        ("end", FindingKind.SIGNAL, "SIGSEGV"),
        ("eat", FindingKind.MEMORY, "address space"),
        ("eat_in_secret", FindingKind.MEMORY, "address space"),
        ("open_outside", FindingKind.ESCAPE, "open"),
        ("open_natively", FindingKind.ESCAPE, "native"),
        ("open_in_secret", FindingKind.ESCAPE, "open"),
        ("change_input", FindingKind.ESCAPE, "open"),
        ("kept", FindingKind.ESCAPE, "open"),
        ("start", FindingKind.ESCAPE, "subprocess.Popen"),
        ("run_code", FindingKind.ESCAPE, "exec"),
        ("pass", FindingKind.FALSE_PASS, "FalsePass"),
        ("say_too_much", FindingKind.MESSAGE, "long"),
        ("say_nothing", FindingKind.MESSAGE, "no code"),
    ],
)
def test_planted_faults_are_found(planted: _Pool, word: str, kind: FindingKind, type_: str) -> None:
    finding = found(planted, word)
    assert (finding.kind, finding.type) == (kind, type_)
    assert said(planted, "").is_accepted, "the next input is read by a process that is as new"


@pytest.mark.slow
@pytest.mark.parametrize(("word", "type_"), [("hang", "slow"), ("wait", "stuck")])
def test_a_reader_that_does_not_end_is_ended(planted: _Pool, word: str, type_: str) -> None:
    finding = found(planted, word)
    assert (finding.kind, finding.type) == (FindingKind.HANG, type_)
    assert "_hang" in finding.trace or "_wait" in finding.trace


def test_a_hang_is_found_by_its_processor_time(planted: _Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.fuzzing.process.MOST_SECONDS", 0.5)
    monkeypatch.setattr("benchmarks.fuzzing.process._GRACE", 0.0)
    assert found(planted, "hang").kind is FindingKind.HANG


def test_a_reader_apart_decides_what_counts(planted: _Pool) -> None:
    outcome = planted.replay("spared", Case("honest", "text.txt", b"crash"))
    assert (outcome.finding, outcome.code) == (None, "text_refused")
    assert planted.replay("spared", Case("honest", "text.txt", b"say_nothing")).finding is not None


@pytest.mark.parametrize(("name", "found"), [("eating_alone", set()), ("eating", {"memory"})])
def test_memory_counts_only_if_the_reader_apart_takes_it_in_a_new_process(tmp_path: Path, name: str, found: set[str]) -> None:
    campaign = Campaign(tmp_path, 0, 1, PLANTED)
    campaign.plan(40, [name])
    campaign.run()
    assert {known.finding.kind.value for known in campaign.state.findings.values()} == found
    assert campaign.state.targets[name].done == 40


def test_an_honest_input_that_is_refused_ends_the_command(planted: _Pool) -> None:
    with pytest.raises(RuntimeError, match="the base honest is refused"):
        planted.replay("dishonest", Case("honest", "text.txt", b"x"))


def figures_of(out: Path) -> tuple[dict[str, tuple[int, int, int]], dict[str, tuple[int, int]]]:
    state = State.of_json((out / "state.json").read_text())
    counts = {name: (c.done, c.accepted, c.refused) for name, c in state.targets.items()}
    return counts, {key: (known.number, known.count) for key, known in state.findings.items()}


def test_a_stopped_campaign_goes_on_with_the_same_inputs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--target", "planted", "--target", "calm", "--workers", "1"]
    assert main([str(tmp_path / "whole"), "--count", "200", *options], PLANTED) == 1
    table = capsys.readouterr().out
    assert "200 of 200 inputs" in table
    for count in ("60", "130", "200"):
        main([str(tmp_path / "parts"), "--count", count, *options], PLANTED)
    assert "200 of 200 inputs" in capsys.readouterr().out
    whole, parts = figures_of(tmp_path / "whole"), figures_of(tmp_path / "parts")
    assert whole[0] == parts[0]
    assert whole[1] == parts[1]
    done = whole[0]["planted"]
    assert done[0] == 150 > done[1] + done[2] > 0
    assert {key.partition(",")[0] for key in whole[1]} >= {"planted: crash", "planted: signal", "planted: message"}


def test_what_another_process_opened_is_no_finding(tmp_path: Path) -> None:
    assert main([str(tmp_path), "--count", "40", "--target", "beside_others", "--workers", "1"], PLANTED) == 0
    counts = State.of_json((tmp_path / "state.json").read_text()).targets["beside_others"]
    assert (counts.done, counts.accepted, counts.refused) == (40, 40, 0)


def test_findings_are_written_reduced_and_can_be_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(
        [str(tmp_path), "--count", "200", "--target", "planted", "--workers", "1", "--json", str(tmp_path / "f.json")], PLANTED
    )
    (place,) = (tmp_path / "findings").glob("planted/honest/crash*/text.txt")
    assert place.read_bytes().split() == [b"crash"]
    capsys.readouterr()
    assert main([str(tmp_path), "--replay", str(place)], PLANTED) == 1
    assert "crash, KeyError" in capsys.readouterr().out
    state = State.of_json((tmp_path / "state.json").read_text())
    number = next(known.number for known in state.findings.values() if known.finding.kind is FindingKind.CRASH)
    assert main([str(tmp_path), "--replay", f"planted/{number}"], PLANTED) == 1
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["inputs"] == 200
    assert figures["core_hours"] >= 0
    assert any("crash" in one["place"] for one in figures["findings"])


def test_a_summary_sums_all_commands_and_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, options = tmp_path / "out", ["--target", "planted", "--workers", "1"]
    assert main([str(out), "--summary"], PLANTED) == 2
    assert not out.exists()
    for count in ("40", "80"):
        main([str(out), "--count", count, *options], PLANTED)
    last = capsys.readouterr().out.splitlines()
    assert main([str(out), "--summary", "--json", str(tmp_path / "f.json")], PLANTED) == 1
    table = capsys.readouterr().out.splitlines()
    assert table == last[-len(table) :]
    counts = State.of_json((out / "state.json").read_text()).targets["planted"]
    assert (counts.done, counts.next, counts.open) == (80, 80, [])
    assert table[-1].startswith(f"80 of 80 inputs, seed 0, {counts.seconds / 3600:.2f} core hours, ")
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["core_hours"] == round(sum(one["core_seconds"] for one in figures["targets"]) / 3600, 3)
    assert figures["kinds"]["crash"] == {"found": 1, "mended": 0, "left": 1, "not_again": 0}
    assert sum(kind["found"] for kind in figures["kinds"].values()) == len(figures["findings"])


def with_other_code(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("benchmarks.fuzzing.campaign.code_of_campaign", lambda: "other code")


def test_a_finding_that_was_mended_is_no_longer_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = [str(tmp_path), "--target", "planted", "--workers", "1"]
    assert main([*options, "--count", "80"], PLANTED) == 1
    found = len(State.of_json((tmp_path / "state.json").read_text()).findings)
    capsys.readouterr()
    with_other_code(monkeypatch)
    assert main([*options, "--count", "80"], "tests.benchmarks.planted:MENDED") == 0
    assert f"{found} different findings, 0 left" in capsys.readouterr().out
    assert main([*options, "--count", "160"], PLANTED) == 1, "it came back"


def test_a_finding_that_does_not_come_again_with_the_same_code_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = [str(tmp_path), "--target", "in_a_state", "--workers", "1", "--count", "40", "--json", str(tmp_path / "f.json")]
    assert main(options, PLANTED) == 1
    (known,) = State.of_json((tmp_path / "state.json").read_text()).findings.values()
    assert known.code
    assert known.not_again == 0
    for again in (1, 2):
        assert main(options, PLANTED) == 1
        assert "did not come again, with the same code" in capsys.readouterr().out
        figures = json.loads((tmp_path / "f.json").read_text())
        assert figures["kinds"]["crash"] == {"found": 1, "mended": 0, "left": 1, "not_again": 1}
        assert [one["not_again"] for one in figures["findings"]] == [again]
    with_other_code(monkeypatch)
    assert main(options, PLANTED) == 0
    assert json.loads((tmp_path / "f.json").read_text())["kinds"]["crash"]["mended"] == 1


def test_a_finding_is_of_the_code_with_which_it_was_last_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = [str(tmp_path), "--target", "planted", "--workers", "1"]
    main([*options, "--count", "80"], PLANTED)
    with_other_code(monkeypatch)
    main([*options, "--count", "80"], PLANTED)
    assert {known.code for known in State.of_json((tmp_path / "state.json").read_text()).findings.values()} == {"other code"}


def test_a_command_that_is_stopped_while_an_input_runs_again_loses_no_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--target", "ending", "--workers", "1", "--count", "40"]

    def stop(*_: object) -> Outcome:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("benchmarks.fuzzing.campaign._Run._again", stop)
        main([str(tmp_path / "stopped"), *options], PLANTED)
    assert figures_of(tmp_path / "stopped") == ({"ending": (0, 0, 0)}, {})
    for out in ("stopped", "whole"):
        assert main([str(tmp_path / out), *options], PLANTED) == 1
    assert figures_of(tmp_path / "stopped") == figures_of(tmp_path / "whole")


@pytest.mark.parametrize(("name", "least"), [("hanging", 0.5), ("ending_late", 0.3)])
def test_the_processor_time_of_workers_that_end_is_counted(
    tmp_path: Path, name: str, least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.fuzzing.process.MOST_SECONDS", 0.5)
    monkeypatch.setattr("benchmarks.fuzzing.process._GRACE", 0.2)
    campaign = Campaign(tmp_path, 0, 1, PLANTED)
    campaign.plan(20, [name])
    campaign.run()
    (known,) = campaign.state.findings.values()
    assert campaign.state.targets[name].seconds > known.count * least


def end_worker(pool: _Pool) -> None:
    (worker,) = pool.workers
    os.kill(worker._process.pid, signal.SIGKILL)
    worker._process.join()


def test_a_worker_that_ended_while_it_was_idle_is_replaced(tmp_path: Path) -> None:
    campaign = Campaign(tmp_path, 0, 1, PLANTED)
    campaign.plan(10, ["calm"])
    with _Pool(1, PLANTED, 0) as pool:
        end_worker(pool)
        _Run(campaign, pool, campaign.state.targets, float("inf"), lambda _: None).run()
        end_worker(pool)
        assert said(pool, "").is_accepted
    assert campaign.state.targets["calm"].done == 10
    assert campaign.state.findings == {}


def test_long_findings_have_folders_of_their_own() -> None:
    frames = [f"stable_data/{'x' * 200}.py:{line} read" for line in (1, 2)]
    folders = {
        KnownFinding("planted", 0, "honest", "text.txt", Finding(FindingKind.CRASH, "KeyError", frame, "")).folder
        for frame in frames
    }
    assert len(folders) == 2
    assert all(len(Path(folder).name) < 200 for folder in folders)


def test_folders_of_killed_commands_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with subprocess.Popen(["true"]) as ended:
        pass
    left, others = (
        tmp_path / f"stable-data-fuzz-{ended.pid}-ab_1",
        [f"stable-data-fuzz-{os.getpid()}-ab_1", "stable-data-fuzz-x-1"],
    )
    for folder in (left, *(tmp_path / name for name in others)):
        (folder / "1").mkdir(parents=True)
    remove_left_behind(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)
    left.mkdir()
    monkeypatch.setattr("benchmarks.fuzzing.campaign._IN_MEMORY", str(tmp_path))
    with _Pool(0, PLANTED, 0):
        there = {path.name for path in tmp_path.iterdir()} - {*others}
        assert [name.startswith(f"stable-data-fuzz-{os.getpid()}-") for name in there] == [True]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


@pytest.mark.slow
def test_a_killed_command_loses_no_input_and_counts_none_twice(tmp_path: Path) -> None:
    # With two workers, which input shows a fault first is chance.
    options = ["--count", "4000", "--target", "planted", "--workers", "1"]
    code = f"from benchmarks.fuzz import main; main([{str(tmp_path / 'killed')!r}, *{options!r}], {PLANTED!r})"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, start_new_session=True, stdout=subprocess.DEVNULL)
    state = tmp_path / "killed" / "state.json"
    while not state.exists() or not any(c.done for c in State.of_json(state.read_text()).targets.values()):
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for out in ("killed", "whole"):
        main([str(tmp_path / out), *options], PLANTED)
    assert figures_of(tmp_path / "killed") == figures_of(tmp_path / "whole")


def test_no_input_outlives_a_killed_command() -> None:
    code = f"""
import time
from benchmarks.fuzzing.campaign import _Pool
from benchmarks.fuzzing.cases import Case
from benchmarks.fuzzing.worker import BEGAN, Replay
pool = _Pool(1, {PLANTED!r}, 0)
(worker,) = pool.workers
worker.send(Replay("planted", Case("honest", "text.txt", b"wait")))
while not worker._progress[BEGAN]:
    time.sleep(0.01)
print(worker._process.pid, flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        number = process.stdout.readline().strip()
        worker = Path("/proc") / number
        time.sleep(0.5)
        is_running = bool(number) and worker.is_dir()
        process.kill()
    assert is_running
    end = time.monotonic() + 60
    while worker.is_dir() and time.monotonic() < end:
        time.sleep(0.1)
    assert not worker.is_dir()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--target", "none"], "no target 'none'"),
        (["--replay", "planted/x"], "--replay is 'planted/x'"),
        (["--replay", "calm"], "--replay is 'calm'"),
    ],
)
def test_what_cannot_start_says_why(
    tmp_path: Path, arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path), *arguments], PLANTED) == 2
    assert reason in capsys.readouterr().err


def test_another_seed_or_a_broken_state_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Campaign(tmp_path, 0, 1, PLANTED).save()
    assert main([str(tmp_path), "--seed", "1"], PLANTED) == 2
    assert "has the seed 0" in capsys.readouterr().err
    (tmp_path / "state.json").write_text("{")
    assert main([str(tmp_path)], PLANTED) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_the_count_is_divided_by_shares() -> None:
    assert divided(10, {"a": 1, "b": 2, "c": 0.5}) == {"a": 3, "b": 6, "c": 1}
