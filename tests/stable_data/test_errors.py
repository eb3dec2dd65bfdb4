"""Messages are one line of a bounded length, whatever they quote."""

import pickle

from stable_data.errors import ConfigError, Notice, failure_line, short_line


def test_a_long_message_keeps_its_beginning_and_its_end() -> None:
    text = str(ConfigError(f"a.json: found {'x' * 100_000}, expected a number", "config_invalid"))
    assert len(text) <= 2000
    assert text.startswith("a.json: found xxx")
    assert text.endswith("xxx, expected a number")
    assert Notice("a", "read", "mesh_invalid", "y" * 100_000).message == short_line("y" * 100_000)


def test_a_message_that_was_cut_stays_as_it_is() -> None:
    error = ConfigError("x\n" * 5000, "config_invalid")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.code) == (str(error), "config_invalid")
    assert short_line(str(error)) == str(error)
    assert str(error).isprintable()


def test_a_short_message_is_not_cut() -> None:
    assert short_line("x" * 2000) == "x" * 2000


def test_the_line_of_a_lost_item_is_short_whatever_its_id_is() -> None:
    assert failure_line("scene", "it has no table") == "scene: it has no table"
    assert failure_line("scene", "scene: it has\nno table") == "scene: it has no table"
    assert failure_line(None, "no id") == "None: no id"
    line = failure_line("x" * 100_000, "it has no table")
    assert len(line) <= 2000
    assert line.endswith("xxx: it has no table")
