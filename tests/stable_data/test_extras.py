"""Every module of an extra is known, and a missing one is named with the command that installs it."""

import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from stable_data.extras import EXTRA_OF_MODULE, install_hint

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]


def test_every_module_of_an_extra_is_known() -> None:
    distributions = {d.split(">")[0].split("[")[0] for e in ("geometry", "sim", "env", "torch", "pipelines") for d in EXTRAS[e]}
    brought = {m for m, of in packages_distributions().items() if {d.lower() for d in of} & distributions and m.isidentifier()}
    always = {"annotated_types", "pydantic", "functorch", "torchgen"}  # of typer, which the library needs; of torch
    assert {m for m in brought if not m.startswith("_")} - always <= set(EXTRA_OF_MODULE)


def test_only_extras_that_exist_are_named() -> None:
    assert {extra for extras in EXTRA_OF_MODULE.values() for extra in extras.split(",")} <= set(EXTRAS)


def test_a_module_of_no_extra_has_no_command() -> None:
    assert install_hint(ModuleNotFoundError(name="stable_data.nothing")) is None
    assert install_hint(ModuleNotFoundError()) is None
