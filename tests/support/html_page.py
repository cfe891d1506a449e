"""A written page as a reader sees it."""

import base64
import json
from html.parser import HTMLParser
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Page(HTMLParser):
    """The page as a reader sees it: cells of the rows of each table, pictures, zoomable plots; `links` leave the file."""

    VOID = ("img", "meta", "link", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.pictures: list[bytes] = []
        self.links: list[str] = []
        self.plots: dict[str, dict[str, Any]] = {}  # by the id of their place
        self.marks: list[dict[str, list[dict[str, Any]]]] = []
        self.places: list[str] = []
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
        if values.get("class") == "plot":
            self.places.append(values["id"])
        self._reads_plots = values.get("type") == "application/json"
        for name in ("src", "href"):
            if values.get(name, "").startswith("data:image/"):
                self.pictures.append(base64.b64decode(values[name].partition(",")[2]))
            elif name in values and not values[name].startswith("#"):
                self.links.append(values[name])

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open[-1:] == ["script"] and self._reads_plots:
            content = json.loads(data)
            self.plots = {plot["place"]: plot for plot in content["figures"]}
            self.marks = content["marks"]
        if "td" in self._open or "th" in self._open:
            self._table[-1][-1] += data


def lines_of(panel: dict[str, Any]) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The instants and values of each line of a plot's panel, by its name."""
    names, lines = [line["name"] for line in panel["series"]], []
    for table in panel["tables"]:
        times, *curves = (np.frombuffer(base64.b64decode(text), "<f4") for text in table)
        lines += [(times, curve) for curve in curves]
    return dict(zip(names, lines, strict=True))
