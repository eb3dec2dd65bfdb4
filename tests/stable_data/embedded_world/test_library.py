"""The embedded world's library as a folder: its own resting tilts, made once."""

from pathlib import Path

import pytest

import stable_data.embedded_world.library as library
from stable_data.embedded_world.families.catalogue import KEYS, LICENCE, asset
from stable_data.embedded_world.library import TILTS_FILE, embedded_library
from stable_data.errors import ConfigError


def test_the_library_is_made_once_and_knows_how_things_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaning = next(key for key in KEYS if len(asset(key).tilts) > 1)
    monkeypatch.setattr(library, "KEYS", (KEYS[0], leaning))
    root, found = embedded_library(tmp_path)
    offered = {a.asset_id: a for a in found.assets if a.is_offered}
    assert set(offered) == {asset(key).uid for key in (KEYS[0], leaning)}
    assert {a.licence for a in found.assets} == {LICENCE}
    for key in (KEYS[0], leaning):
        made = asset(key)
        tilts = [t.quat_xyzw for t in offered[made.uid].tilts]
        assert tilts[0] == pytest.approx(made.tilts[0])
        assert len(tilts) == len(made.tilts)
    assert [p.name for p in tmp_path.iterdir()] == [root.name]
    monkeypatch.setattr(library, "write_library", None)  # not made again
    assert embedded_library(tmp_path)[1].assets == found.assets
    (root / TILTS_FILE).write_text("{")
    with pytest.raises(ConfigError, match="delete the folder"):
        embedded_library(tmp_path)
