"""Pages: HTML files that need nothing else, from the templates beside this file."""

import base64
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Write a template with its content and return the path."""
    path.write_text(_ENVIRONMENT.get_template(template).render(content), encoding="utf-8")
    return path


def data_uri(png: bytes) -> str:
    """Return a picture as the text that embeds it in a page."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
