"""The store whose requests fail: its clients get what they wrote, and the same requests are hit each time."""

from collections import Counter
from pathlib import Path

import pytest

from benchmarks.faults.faulty_store import FaultyStore, Rates, _Faults
from benchmarks.faults.s3_server import CREDENTIALS
from stable_data.storage.run_folder import RunFolder

FILES = {f"report/{number}.bin": bytes([number]) * 1000 * number for number in range(8)}


def hits(seed: int, count: int = 4000) -> list[str]:
    faults = _Faults(seed, Rates())
    return [faults.next()[0] for _ in range(count)]


def test_the_shares_are_those_asked_for_and_the_same_requests_are_hit() -> None:
    assert hits(1) == hits(1) != hits(2)
    share = {kind: count / 4000 for kind, count in Counter(hits(1)).items() if kind}
    assert share == pytest.approx({"failed": 0.05, "slow": 0.02, "torn": 0.01}, abs=0.01)


@pytest.mark.slow  # two servers
def test_what_was_written_is_read_again_and_kept_for_the_next_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    store = FaultyStore(tmp_path, 3, Rates(failed=0.2, slow=0.0, torn=0.2))
    try:
        run = RunFolder(store.uri("run"))
        for name, content in FILES.items():
            run.write_bytes(name, content)
        assert {name: run.read_bytes(name) for name in FILES} == FILES
        found = store.counts()
        assert found["requests"] > 2 * len(FILES)
        assert min(found["failed"], found["torn"]) >= 3
        store.save()
        RunFolder(store.calm_uri("run")).write_bytes("report/late.bin", b"not stored")
    finally:
        store.close()
    store = FaultyStore(tmp_path, 3, Rates(0.0, 0.0, 0.0))
    try:
        run = RunFolder(store.uri("run"))
        assert {name: run.read_bytes(name) for name in FILES} == FILES
        assert run.read_bytes("report/late.bin") is None
    finally:
        store.close()
