"""The wheel in a virtual environment of its own, as somebody without this clone has it."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

TIMEOUT_S = 500


def run(folder: Path, *command: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a command without this clone on Python's path; it must end with `code`."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))
    }
    ran = subprocess.run(
        list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True,
        timeout=TIMEOUT_S,
    )  # fmt: skip
    assert ran.returncode == code, ran.stdout[-4000:] + ran.stderr[-4000:]
    return ran


def install(wheel: Path, folder: Path) -> tuple[Path, Path]:
    """Install a wheel into `folder`/site with all packages of this environment; returns its programs and its packages."""
    run(folder, sys.executable, "-m", "venv", "--without-pip", "site")
    programs = folder / "site" / "bin"
    pip = (sys.executable, "-m", "pip", "--python", programs / "python")
    run(folder, *pip, "install", "--quiet", "--no-index", "--no-deps", wheel)
    find = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    packages = Path(run(folder, programs / "python", "-c", find).stdout.strip())
    # Theirs alone: no .pth is read there, so not that of the project itself.
    (packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    return programs, packages
