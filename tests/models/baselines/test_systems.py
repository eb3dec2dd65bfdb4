"""The rows of the paper's comparison: each name gives valid settings, and asks for what it lacks."""

from operator import attrgetter

import pytest

from models.baselines.systems import SYSTEMS, system_named
from pipelines.generate.settings import GenerateSettings
from pipelines.settings import resolve_settings
from stable_data.errors import ConfigError


def settings_of(name: str, *more: str) -> GenerateSettings:
    return resolve_settings(GenerateSettings, "generate", None, [*system_named(name).overrides, *more])


ENGINE = 'engine.engine="openai:gpt-4o"'
NEEDED = {"mesatask": ENGINE, "mesatask_refined": ENGINE, "zero_shot": ENGINE, "files": "layout_files=runs/theirs"}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_name_gives_the_settings_of_its_row(name: str) -> None:
    system = SYSTEMS[name]
    settings = settings_of(name, *filter(None, [NEEDED.get(name)]))
    assert {key: attrgetter(key)(settings) for key in system.settings} == dict(system.settings)
    assert settings.accept == ""  # a row is a mean over all scenes
    untouched = GenerateSettings()
    for key in {"schedule", "corrects", "corrector", "layout"} - system.settings.keys():
        assert getattr(settings, key) == getattr(untouched, key)


def test_systems_say_what_they_need_and_layouts_of_others_are_not_run_without_them() -> None:
    assert all(SYSTEMS[name].needs for name in NEEDED)
    with pytest.raises(ConfigError, match="layout_files"):
        settings_of("files")


def test_explicit_settings_win() -> None:
    settings = settings_of("steerable", "corrects=each", "accept=clean", "corrector=steerable_parts")
    assert (settings.corrects, settings.accept, settings.corrector) == ("each", "clean", "steerable_parts")


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="zero_shot"):
        system_named("gpt")


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["layout=files"], "layout_files is empty"),
        (["layout_files=runs/theirs"], "layout is stages"),
        (["corrector=steerable", "correctors=2"], "correctors is 2"),
        (["corrector=steerabel"], "expected"),
        (["layout=tabletopgen"], "expected"),
        (["reasoner.dialect=mesatask", 'engine.engine="openai:mesatask"'], "set schedule to whole"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(overrides: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        resolve_settings(GenerateSettings, "generate", None, overrides)


def test_every_row_of_the_paper_has_a_system() -> None:
    rows = {"GPT-4o", "Holodeck-Table", "I-Design-Table", "MesaTask", "TabletopGen", "Steerable", "Ours"}
    assert rows <= {system.row for system in SYSTEMS.values()}
