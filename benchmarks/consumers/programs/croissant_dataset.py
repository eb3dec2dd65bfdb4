"""mlcroissant validates croissant.json of a folder that publish wrote, and reads records of each record set; see README.md."""

import itertools
import json
import logging
import os
import sys
from pathlib import Path
from typing import Any

import mlcroissant

_RECORDS = 3  # of each record set


def look(folder: Path) -> dict[str, Any]:
    """Validates a folder, and counts the records that can be read."""
    os.chdir(folder)  # files are named relative to croissant.json
    dataset = mlcroissant.Dataset(jsonld=str(folder / "croissant.json"))
    issues = dataset.metadata.ctx.issues
    read = {}
    for records in dataset.metadata.record_sets:
        read[records.id] = sum(1 for _ in itertools.islice(dataset.records(records.id), _RECORDS))
    return {"error": None, "problems": sorted(issues.errors), "remarks": sorted(issues.warnings), "records": read}


logging.disable(logging.WARNING)
request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file).absolute())
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
