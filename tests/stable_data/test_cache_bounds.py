"""What a process keeps for the names that it meets has a bound: a model may invent new ones as long as it runs."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FEW = {
    "arrangement._foot",
    "catalog._leaning",
    "catalogue.asset",
    "encoder.load_default",
    "facts.style",
    "page._part",
    "settings._hints",
    "settings._model_around",
    "settings._model_of_fields",
    "settings.setting_meanings",
    "user_cache._code",
}
"""Functions whose arguments are few things of this project: its settings, its files, the assets of the embedded world."""


def unbounded(path: Path) -> list[str]:
    """The functions of a file with arguments, whose results are all kept."""
    text = path.read_text("utf-8")
    if "@cache" not in text and "maxsize=None" not in text:  # parsing takes nearly all the time
        return []
    return [
        node.name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
        and {ast.unparse(decorator) for decorator in node.decorator_list} & {"cache", "lru_cache(maxsize=None)"}
        and ast.unparse(node.args)
    ]


def test_only_what_has_few_arguments_is_kept_without_a_bound() -> None:
    found = {
        f"{path.stem}.{name}"
        for package in ("stable_data", "models", "pipelines")
        for path in (ROOT / package).rglob("*.py")
        for name in unbounded(path)
    }
    assert found == FEW
