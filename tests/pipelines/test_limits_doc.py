"""The page on limits: its tables are those of the code."""

import re
from itertools import groupby
from pathlib import Path

from pipelines.settings import JOBS
from pipelines.supports import SECONDS_PER_ITEM
from stable_data.limits import list_limits

PAGE = Path(__file__).parents[2] / "docs" / "limits.md"


def shown(value: int | float) -> str:
    """A number as the page shows it: bytes as they are usually counted."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if isinstance(value, int) and value >= size and value % size == 0:
            return f"{value // size} {unit}"
    return f"{value:,}"


def limit_tables() -> str:
    """A table for each group of limits, under what the group is about."""
    text = ""
    for group, found in groupby(list_limits(), lambda one: one.group):
        limits = list(found)
        text += f"\n### {group}\n\n{limits[0].about}\n\n| limit | default | what it limits |\n|---|---|---|\n"
        for one in limits:
            default = shown(one.default) if one.name.endswith("_bytes") else f"{one.default:,}"
            text += f"| `{one.name}` | {default} | {one.meaning} |\n"
    return text


def job_rows() -> list[str]:
    seconds = {verb: getattr(place.defaults(), "seconds_per_item", None) for verb, place in JOBS.items()}
    seconds["supports"] = SECONDS_PER_ITEM  # a job without a file of settings
    return [f"| {verb} | {value:g} |" for verb, value in seconds.items() if value is not None]


def rows_after(head: str) -> list[str]:
    text = PAGE.read_text("utf-8").partition(f"| {head} |")[2]
    return re.match(r"[^\n]*\n\|[-|]*\|\n((?:\|[^\n]*\n)*)", text)[1].splitlines()  # type: ignore[index]


def test_the_page_lists_the_limits_of_the_code() -> None:
    found = PAGE.read_text("utf-8").partition("## All limits\n")[2]
    assert found == limit_tables(), f"docs/limits.md should have:\n{limit_tables()}"


def test_the_page_lists_the_times_of_all_jobs() -> None:
    assert rows_after("job") == job_rows(), "\n".join(["docs/limits.md should have:", *job_rows()])
    assert len(job_rows()) >= 8
