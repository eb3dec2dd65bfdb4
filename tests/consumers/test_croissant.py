"""mlcroissant, the reference implementation of MLCommons Croissant, validates and reads published runs."""

from pathlib import Path

import pytest

from benchmarks.consumers.environment import CROISSANT
from stable_data.publishing.publisher import PublishOptions, publish
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.verifier import VerifyOptions

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.mark.parametrize("kind", ["generated", "imported", "clean_run"])
def test_croissant_metadata_are_valid_and_records_are_read(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    if not CROISSANT.is_there:
        pytest.skip(CROISSANT.missing)
    run: Path = request.getfixturevalue(kind)
    options = PublishOptions(
        licence="CC-BY-4.0",
        url="https://example.org/tables",
        citation="Somebody: Tables, 2026.",
        verify=VerifyOptions(verdicts="none"),
    )
    publish(RunFolder(str(run)), tmp_path / "out", options, print)
    [seen] = CROISSANT.open([tmp_path / "out"])
    assert seen["error"] is None
    assert (seen["problems"], seen["remarks"]) == ([], [])
    tables = {path.parent.name for path in (tmp_path / "out").glob("*/part-*.parquet")}
    named = {name for name in tables if RunFolder(str(tmp_path / "out")).num_rows(name)}
    assert seen["records"].keys() == named | {"licences"}
    assert all(count > 0 for count in seen["records"].values())
