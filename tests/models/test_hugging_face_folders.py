"""Folders of models from elsewhere: no code in them is run."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_no_folder_of_a_model_may_bring_code() -> None:
    """Each call that opens one says so: by default some versions of the library ask on the terminal."""
    seen, offending = 0, []
    for package in ("models", "pipelines", "stable_data"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text("utf-8")
            if "from_pretrained" not in text:  # parsing takes nearly all the time
                continue
            for node in ast.walk(ast.parse(text)):
                if not (isinstance(node, ast.Call) and ast.unparse(node.func).endswith("from_pretrained")):
                    continue
                seen += 1
                given = {word.arg: ast.unparse(word.value) for word in node.keywords}
                is_auto = ast.unparse(node.func).startswith("Auto")
                if given.get("local_files_only") != "True" or (is_auto and given.get("trust_remote_code") != "False"):
                    offending.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert seen > 6
    assert not offending
