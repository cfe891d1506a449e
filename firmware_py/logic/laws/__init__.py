"""Control laws that ship, written as a user writes one; a profile names them: `[logic] controller = "lqr"`."""

from pathlib import Path

SHIPPED_LAWS = {
    path.stem: str(path) for path in sorted(Path(__file__).parent.glob("[!_]*.py"))
}  # files by name
