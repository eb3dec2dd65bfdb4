"""Jobs to which faults happen end with the rows of an undisturbed run; what is not the same is told."""

import json
import re
import signal
import time
from functools import partial
from pathlib import Path
from threading import Thread, main_thread
from typing import Any

import pytest

from benchmarks import chaos
from benchmarks.faults import shifted_clock
from benchmarks.faults.comparison import compared
from benchmarks.faults.plan import FaultKind
from pipelines.sources.assets import AssetLibraries
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.scripts import one_thing_a_stage

SAME = {
    "lost": 0,
    "different": 0,
    "doubled": 0,
    "added": 0,
    "files_that_differ": 0,
    "columns_that_differ": [],
}


def notice(number: int, message: str = "m") -> dict[str, str]:
    return {"id": f"scene_{number}", "step": "s", "code": "c", "message": f"{message} {number}"}


def run_of(place: Path, *shards: list[dict[str, str]]) -> RunFolder:
    folder = RunFolder(str(place))
    folder.write_shard("scenes", "00", [])
    for number, rows in enumerate(shards):
        folder.write_shard("failures", f"0{number}", rows)
    return folder


def test_what_is_lost_different_doubled_or_added_is_counted(tmp_path: Path) -> None:
    rows = [notice(number) for number in range(4)]
    clean = run_of(tmp_path / "clean", rows[:2], rows[2:])
    assert compared(clean, run_of(tmp_path / "same", rows[:2], rows[2:])) == {"rows": 4} | SAME
    assert compared(clean, run_of(tmp_path / "order", rows[1::-1], rows[2:])) == {"rows": 4} | SAME
    assert compared(clean, run_of(tmp_path / "lost", rows[:2])) == {"rows": 4} | SAME | {"lost": 2}
    assert compared(clean, run_of(tmp_path / "doubled", rows[:2], rows[2:], rows[:1])) == {"rows": 4} | SAME | {"doubled": 1}
    assert compared(clean, run_of(tmp_path / "added", rows[:2], [*rows[2:], notice(9)])) == {"rows": 4} | SAME | {"added": 1}
    changed = compared(clean, run_of(tmp_path / "changed", rows[:2], [notice(2, "other"), rows[3]]))
    assert changed == {"rows": 4} | SAME | {"different": 1, "columns_that_differ": ["failures.message"]}
    both = compared(clean, run_of(tmp_path / "both", rows[:2], rows[1:3]))
    assert both == {"rows": 4} | SAME | {"lost": 1, "doubled": 1}
    (tmp_path / "same" / "dataset").mkdir()
    (tmp_path / "same" / "dataset" / "layout.json").write_text("{}", "utf-8")
    assert compared(clean, RunFolder(str(tmp_path / "same")))["files_that_differ"] == 1


def test_faults_are_read() -> None:
    assert chaos.faults_of(None, 4, in_store=False) == tuple(FaultKind)
    assert FaultKind.FULL_DISK not in chaos.faults_of(None, 4, in_store=True)
    assert chaos.faults_of("clock, kill_driver", 1, in_store=True) == (FaultKind.KILL_DRIVER, FaultKind.CLOCK)
    with pytest.raises(ConfigError, match=r"--faults has 'meteor', expected some of kill_driver, .*"):
        chaos.faults_of("meteor", 4, in_store=False)
    with pytest.raises(ConfigError, match="full_disk, but the run is in a store"):
        chaos.faults_of("full_disk", 4, in_store=True)
    with pytest.raises(ConfigError, match="--kills is 3, expected at least one for each of the 4 kinds"):
        chaos.faults_of(None, 3, in_store=False)


def test_a_fault_that_did_not_hit_is_missed(dataset: Path, tmp_path: Path) -> None:
    settings = chaos.ChaosSettings("correct", 3, 20, 0, (FaultKind.KILL_HEAD, FaultKind.CLOCK), None, True, 2, 8, ())
    work = chaos.ChaosWork(dataset, tmp_path / "work", settings)
    work.course.hits = {"kill_head": 20, "clock": 1}
    work.requests.update(requests=900, failed=40, slow=20)
    found = work.figures()
    assert found["hits"] == {"kill_head": 20, "clock": 1}
    assert found["missed"] == ["clock: 1 of 2", "store: no request was torn"]
    work.course.hits["clock"] = 2
    work.requests.update(torn=9)
    assert work.figures()["missed"] == []


def test_options_after_two_dashes_are_those_of_the_job(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chaos.ChaosWork, "run_undisturbed", lambda self: False)
    words = [str(dataset), "--out", str(tmp_path / "work"), "--faults", "clock", "--", "--set", "weights=none"]
    monkeypatch.setattr(chaos.ChaosWork, "try_faults", lambda self: None)
    assert chaos.run_campaign(words) == chaos.NOT_COMPLETE
    work = chaos.ChaosWork(
        dataset,
        tmp_path / "work",
        chaos.ChaosSettings("generate", 4, 8, 0, (FaultKind.CLOCK,), None, False, 2, 8, ("--set", "weights=none")),
    )
    assert work.command("out")[-2:] == ["--set", "weights=none"]


def test_a_folder_of_other_settings_or_too_few_scenes_are_refused(dataset: Path, tmp_path: Path) -> None:
    settings = chaos.ChaosSettings("correct", 3, 4, 0, (FaultKind.CLOCK,), None, False, 2, 8, ())
    work = chaos.ChaosWork(dataset, tmp_path / "work", settings)
    work.course.hits["clock"] = 1
    work.save()
    assert len(list((tmp_path / "work" / "data" / "Layout_info").glob("*/*/layout.json"))) == 3
    assert chaos.ChaosWork(dataset, tmp_path / "work", settings).course.hits == {"clock": 1}
    with pytest.raises(ConfigError, match="kills: 4 -> 5"):
        chaos.ChaosWork(
            dataset, tmp_path / "work", chaos.ChaosSettings("correct", 3, 5, 0, (FaultKind.CLOCK,), None, False, 2, 8, ())
        )
    with pytest.raises(ConfigError, match="has 4 scenes, expected at least 5"):
        chaos.ChaosWork(
            dataset, tmp_path / "other", chaos.ChaosSettings("correct", 5, 4, 0, (FaultKind.CLOCK,), None, False, 2, 8, ())
        )


def test_a_folder_of_other_code_is_refused(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = chaos.ChaosSettings("correct", 3, 4, 0, (FaultKind.CLOCK,), None, False, 2, 8, ())
    chaos.ChaosWork(dataset, tmp_path / "work", settings).save()
    monkeypatch.setattr(chaos, "code_version", lambda: "0.1.0+0")
    with pytest.raises(ConfigError, match=r"code_version: .* -> 0\.1\.0\+0"):
        chaos.ChaosWork(dataset, tmp_path / "work", settings)


@pytest.mark.parametrize("kind", [FaultKind.CLOCK, FaultKind.FULL_DISK])
def test_a_fault_that_cannot_happen_is_told_before_the_undisturbed_run(
    kind: FaultKind, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shifted_clock, "_LIBRARIES", ())
    monkeypatch.delenv("FAKETIME_LIBRARY", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))  # without mkfs and mount
    words = [str(dataset), "--out", str(tmp_path / "work"), "--scenes", "3", "--kills", "0", "--faults", str(kind)]
    assert chaos.status_of(lambda: chaos.run_campaign(words)) == 2
    assert re.search("error: .*(the clock cannot be shifted|no disk can be mounted)", capfd.readouterr().err)
    assert not (tmp_path / "work" / "clean").exists()
    assert not list((tmp_path / "work").glob(".trial_*"))


@pytest.mark.slow
def test_a_store_on_this_machine_is_tried(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = chaos.ChaosSettings("correct", 3, 0, 0, (), None, True, 2, 8, ())
    work = chaos.ChaosWork(dataset, tmp_path / "work", settings)
    work.try_faults()
    monkeypatch.setattr(RunFolder, "read_bytes", lambda self, name: None)
    with pytest.raises(ConfigError, match="no object store can be served on this machine"):
        work.try_faults()


def test_an_error_of_the_campaign_has_a_status_of_its_own(capfd: pytest.CaptureFixture[str]) -> None:
    def ended(error: BaseException) -> int:
        def campaign() -> int:
            raise error

        return chaos.status_of(campaign)

    assert chaos.status_of(lambda: 1) == 1
    assert ended(TimeoutError("no node")) == 2
    assert "TimeoutError: no node" in capfd.readouterr().err
    assert ended(ConfigError("c", "usage")) == 2
    assert capfd.readouterr().err == "error: c\n"
    assert ended(KeyboardInterrupt()) == 130


def test_a_verification_without_a_verdict_is_an_error(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", [notice(0)])
    assert chaos.verified(run.uri)["is_whole"] is False
    with pytest.raises(RuntimeError, match="ended with status 2: error: "):
        chaos.verified(str(tmp_path / "none"))


def test_figures_without_an_output_of_verify_are_shown(
    dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    work = chaos.ChaosWork(
        dataset, tmp_path / "work", chaos.ChaosSettings("correct", 3, 0, 0, (FaultKind.CLOCK,), None, False, 2, 8, ())
    )
    work.course.rounds, work.clean_seconds, work.course.finished_early, work.course.stops = 2, 9.0, 4, 1
    work.course.rows = {"rows": 4, "is_whole": True, "verify": []} | SAME
    chaos.show(work.figures())
    shown = capfd.readouterr().out
    assert re.search("stable-data verify +whole: no output", shown)
    assert re.search("ended by itself before a fault +4 times done, 1 times with an error", shown)


@pytest.mark.slow
def test_an_interrupted_undisturbed_run_ends_cleanly_and_is_continued(
    dataset: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    request.addfinalizer(partial(signal.signal, signal.SIGINT, signal.getsignal(signal.SIGINT)))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
    settings = chaos.ChaosSettings("correct", 4, 0, 0, (FaultKind.CLOCK,), None, False, 1, 1, ("--set", "weights=none"))
    log = tmp_path / "work" / "clean.log"
    work = chaos.ChaosWork(dataset, tmp_path / "work", settings)

    def interrupt() -> None:
        while not log.exists() or b"correct:" not in log.read_bytes():
            time.sleep(0.05)
        signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)  # sent to the process, it may not wake this thread

    Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        work.run_undisturbed()
    assert "interrupted; finished files stay" in log.read_text("utf-8")
    assert chaos.ChaosWork(dataset, tmp_path / "work", settings).run_undisturbed()


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty scenes."""
    root = tmp_path_factory.mktemp("many") / "data"
    write_world(root, 40, EmbeddedWorld(seed=3, pictures=False))
    return root


def figures_of(data: Path, tmp_path: Path, *words: str, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Runs the benchmark to its end; its status is not 0 if the rows differ, or if a fault did not hit or did not end as it must."""
    out = tmp_path / "figures.json"
    try:
        status = chaos.run_campaign([str(data), "--out", str(tmp_path / "work"), "--json", str(out), *words, "--", *more])
    except ConfigError as error:
        if error.code in ("disk_not_mounted", "clock_not_shifted"):
            pytest.skip(str(error))
        raise
    assert status == 0
    found: dict[str, Any] = json.loads(out.read_text("utf-8"))
    return found


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_generate_with_killed_drivers_workers_nodes_and_heads(
    many: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(many)]).libraries[0].assets[1:4])))
    words = ["--scenes", "40", "--kills", "8", "--per-shard", "2", "--faults", "kill_driver,kill_worker,kill_node,kill_head"]
    found = figures_of(many, tmp_path, *words, more=("--engine", f"scripted:{script}", "--set", "weights=none"))
    assert found["hits"] == dict.fromkeys(("kill_driver", "kill_worker", "kill_node", "kill_head"), 2)
    assert found["stops"] == 0, found["last_words"]
    assert found["rows"] >= 40


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_preprocess_with_two_drivers_and_a_clock_that_jumps(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["--job", "preprocess", "--scenes", "4", "--kills", "0", "--per-shard", "1", "--faults", "clock,two_drivers"]
    found = figures_of(dataset, tmp_path, *words, more=("--set", "assets_per_shard=2", "--set", "all_assets=false"))
    assert found["hits"] == {"clock": 1, "two_drivers": 1}


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_preprocess_with_a_full_disk(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["--job", "preprocess", "--scenes", "4", "--kills", "0", "--per-shard", "1", "--faults", "full_disk"]
    found = figures_of(dataset, tmp_path, *words, more=("--set", "assets_per_shard=2", "--set", "all_assets=false"))
    assert found["hits"] == {"full_disk": 1}


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_correct_with_two_drivers_and_killed_workers_in_a_store_that_fails(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["--job", "correct", "--scenes", "4", "--kills", "1", "--per-shard", "1", "--faults", "kill_worker,two_drivers"]
    found = figures_of(dataset, tmp_path, *words, "--faulty-store", more=("--set", "weights=none"))
    assert found["hits"] == {"kill_worker": 1, "two_drivers": 1}
    assert found["requests"]["failed"] > 0
