"""The exceptions of the laboratory; the command line turns them into one line and exit code 2."""

import difflib
import reprlib
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from firmware_py.extras import install_command

OURS = [Path(__file__).parent.parent / package for package in ("hil", "ground_station", "firmware_py")]
PYTHON = Path(traceback.__file__).parent


class LabError(Exception):
    """A user's request is invalid; the text has the key, the value, and what is allowed."""

    @property
    def lines(self) -> list[str]:
        """The text as the command line shows it: one line."""
        return [" ".join(str(self).split())]


class RefusedFileError(LabError):
    """A file of the user is refused at several places: a line of the text for each."""

    @property
    def lines(self) -> list[str]:
        """The text, line by line."""
        return str(self).splitlines()


class OutputError(OSError):
    """The standard output cannot be written, unlike the file that a command writes meanwhile."""


def require(what: str, extra: str, *modules: str) -> None:
    """Raise `LabError` with the command that installs an extra when `what` needs a missing module."""
    for module in modules:
        if find_spec(module) is None:
            raise LabError(f"{what}: {module} is missing: {install_command(extra)}")


@contextmanager
def refusing(start: str, *kinds: type[Exception]) -> Iterator[None]:
    """Turn errors of these kinds into a `LabError` whose text begins with `start`."""
    try:
        yield
    except kinds as error:
        raise LabError(f"{start}{getattr(error, 'strerror', None) or error}") from None


@contextmanager
def reading(what: object) -> Iterator[None]:
    """Turn what damaged content causes while a folder or file of somebody else is read into a `LabError`.

    Errors of the operating system pass: they may concern what is written meanwhile.
    """
    try:
        yield
    except (LabError, OSError):
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        raise LabError(f"{what}: damaged, or of another version ({type(error).__name__}: {text})") from error


@contextmanager
def writing(option: str, path: Path | None) -> Iterator[None]:
    """Turn an `OSError` while writing to an option's path into a `LabError` that names the option."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise LabError(f"{option} {path}: cannot be written ({error.strerror or error})") from None


def unlinked(path: Path) -> Path:
    """Return a path whose file was deleted: in a folder of somebody else it could be a link to a file of the user."""
    path.unlink(missing_ok=True)
    return path


def made_folder(option: str, path: Path) -> Path:
    """Make an option's folder if it is missing, and return it. Raises `LabError`."""
    with writing(option, path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def require_empty(option: str, folder: Path) -> None:
    """Raise `LabError` for a folder with content, or a path that is not a folder."""
    with refusing(f"{option} {folder}: ", OSError):
        used = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if used:
        raise LabError(f"{option} {folder}: it exists and is not empty; choose a folder that is new or empty")


LISTED = 12  # names in one line


def hint(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return the nearest of the known words as a question; else `otherwise`, or a dozen of them."""
    names = list(known)
    near = difflib.get_close_matches(word, names, 1, 0.5)
    if near:
        return f"did you mean {near[0]}?"
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return otherwise or f"there are {', '.join(names[:LISTED]) or 'none'}{more}"


def shown(value: object) -> str:
    """Return a value for one line of an error, shortened."""
    return " ".join(reprlib.repr(value).split()).encode(errors="backslashreplace").decode()


def blame(error: BaseException) -> str:
    """Return an error of the user's code as one line: file, line and message."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, SyntaxError):
        place = f"{Path(error.filename).name}:{error.lineno}: " if error.filename else ""
        return f"{place}{error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [frame for frame in frames if not _is_known(Path(frame.filename))]
    if not theirs:
        return text
    where = [frame for frame in theirs if frame.filename == theirs[0].filename][-1]
    kind = "" if isinstance(error, LabError) else f"{type(error).__name__}: "
    return f"{Path(where.filename).name}:{where.lineno}: {kind}{text}"


def _is_known(file: Path) -> bool:
    """Whether a file belongs to this project or to Python."""
    if file.name.startswith("<") or any(file.is_relative_to(folder) for folder in OURS):
        return True
    if file.is_relative_to(PYTHON) and "site-packages" not in file.parts:
        return True
    return file.parent.name == "importlib_metadata"  # replaces Python's own if installed
