"""The files in schemas/ are in step with the code, and accept what the code writes."""

import json
import subprocess
import sys
from pathlib import Path

import jsonschema

from stable_data.storage.json_schemas import contract_files, scene_schema, tables_document
from stable_data.storage.schemas import SCHEMAS

FOLDER = Path(__file__).resolve().parents[1] / "schemas"


def test_the_checked_in_contracts_are_in_step_with_the_code() -> None:
    found = {p.name: p.read_text("utf-8") for p in FOLDER.iterdir()}
    assert found == contract_files(), "run `make schemas`"


def test_every_contract_is_a_valid_json_schema() -> None:
    for name, content in contract_files().items():
        if name.endswith(".schema.json"):
            jsonschema.Draft202012Validator.check_schema(json.loads(content))


def test_the_scene_schema_names_every_column() -> None:
    assert list(scene_schema()["properties"]) == SCHEMAS["scenes"].names


def test_the_contracts_do_not_depend_on_docstrings() -> None:
    """``python -OO`` removes docstrings."""
    code = "from stable_data.storage.json_schemas import tables_document; import json; print(json.dumps(tables_document()))"
    done = subprocess.run([sys.executable, "-OO", "-c", code], capture_output=True, text=True, cwd=FOLDER.parent)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == tables_document()
