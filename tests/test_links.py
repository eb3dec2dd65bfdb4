"""Links of the Markdown pages lead to files and headings that exist, and the glossary names code that exists."""

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "models" / "weights").rglob("*.md")])
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text("utf-8")
NAMED = sorted(set(re.findall(r"\| `((?:stable_data|models)\.[\w.]+)` \|$", GLOSSARY, re.MULTILINE)))


def prose(page: Path) -> str:
    """A page without its blocks of code, where brackets and number signs mean other things."""
    return re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> Iterator[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    for heading in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        yield re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if link.startswith(("https://", "http://")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link} of {page.name}"
        if anchor:
            assert anchor in set(anchors(target)), f"{link} of {page.name}"


def test_every_page_is_in_the_navigation() -> None:
    index = ROOT / "docs" / "index.md"
    listed = re.findall(r"^- \[.+?\]\((\w+\.md)\)", index.read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs").glob("*.md") if page != index)


@pytest.mark.parametrize("name", NAMED)
def test_what_the_glossary_names_exists(name: str) -> None:
    try:
        import_module(name)
    except ModuleNotFoundError:
        module, _, attribute = name.rpartition(".")
        assert hasattr(import_module(module), attribute), name


def test_the_glossary_defines_each_term_once_and_names_much_of_the_code() -> None:
    terms = [term for term in re.findall(r"^\| (.+?) \|", GLOSSARY, re.MULTILINE) if term != "term"]
    assert len(terms) == len(set(terms))
    assert len(NAMED) > 40
