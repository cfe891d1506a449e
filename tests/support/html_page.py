"""A written page as a reader sees it."""

import base64
from html.parser import HTMLParser


class Page(HTMLParser):
    """The page as a reader sees it: cells of the rows of each table, pictures, headings; `links` leave the file."""

    VOID = ("img", "meta", "link", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.pictures: list[bytes] = []
        self.links: list[str] = []
        self.scripts = 0
        self._open: list[str] = []
        self._table: list[list[str]] = []
        self.feed(text)
        assert self._open == [], "every element is closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        if tag not in self.VOID:
            self._open.append(tag)
        if tag == "table":
            self._table = self.tables[values["id"]] = []
        elif tag == "tr":
            self._table.append([])
        elif tag in ("td", "th"):
            self._table[-1].append("")
        self.scripts += tag == "script"
        for name in ("src", "href"):
            if values.get(name, "").startswith("data:image/png;base64,"):
                self.pictures.append(base64.b64decode(values[name].partition(",")[2]))
            elif name in values:
                self.links.append(values[name])

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "td" in self._open or "th" in self._open:
            self._table[-1][-1] += data
