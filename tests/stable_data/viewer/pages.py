"""What a page contains, read by a parser of HTML."""

import base64
from html.parser import HTMLParser


class Page(HTMLParser):
    """The elements of a page: their attributes, the texts of scripts, and all other text."""

    def __init__(self, content: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.models: dict[int, bytes] = {}
        self.articles: list[str] = []
        self._is_in: str | None = None
        self._number: int | None = None
        self.open = list[str]()
        self.feed(content)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.elements.append((tag, found))
        self._is_in = tag if tag in ("script", "style") else None
        if tag == "script":
            number = found.get("data-model")
            self._number = None if number is None else int(number)
        if tag == "article":
            self.articles.append("")
        if tag in ("article", "nav", "aside", "main", "ul", "ol", "li", "table", "dl"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        self._is_in = None
        if tag in ("article", "nav", "aside", "main", "ul", "ol", "li", "table", "dl"):
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._is_in == "script":
            if self._number is None:
                self.scripts.append(data)
            else:
                self.models[self._number] = base64.b64decode(data, validate=True)
        elif self._is_in is None and "article" in self.open:
            self.articles[-1] += data

    def values(self, *names: str) -> list[str]:
        """The values of some attributes."""
        return [value or "" for _, attributes in self.elements for name, value in attributes.items() if name in names]
