"""Programs of others: one that ends over a file loses this file and no other, and is no scene at rest."""

from pathlib import Path

import pytest

from benchmarks.consumers import environment
from benchmarks.consumers.comparison import differences, stays
from benchmarks.consumers.environment import OURS, Consumer
from stable_data.errors import ConfigError

PROGRAM = """
import json, os, sys
for file in json.load(sys.stdin)["files"]:
    if "bad" in file:
        os._exit(3)
    print("SEEN", json.dumps({"error": None, "bodies": {}}), flush=True)
"""


def test_a_program_that_ends_over_a_file_goes_on_with_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "programs").mkdir()
    (tmp_path / "programs" / "frail.py").write_text(PROGRAM)
    monkeypatch.setattr(environment, "_HERE", tmp_path)
    consumer = Consumer("frail", "usd", OURS)
    seen = consumer.open([Path(name) for name in ("a", "bad_1", "b", "bad_2")])
    assert [saw["error"] is None for saw in seen] == [True, False, True, False]
    assert "status 3" in seen[1]["error"]
    assert stays({}, seen[1]) is None
    assert differences({}, seen[1])
    with pytest.raises(ConfigError, match="frail does not run: status 3"):
        consumer.open([Path("bad")])
