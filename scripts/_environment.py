"""The virtual environment of this project, made once and then found again (shared by run.py, test.py and comparisons).

A finished environment has a stamp: a file with the text of setup.cfg and pyproject.toml, the Python, the folder and
the extras.  If the stamp is missing or differs (a changed file, another Python, an interrupted installation), the
environment is made again.  clrecon itself is installed editable, so that a changed source file needs no new
installation.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
_TICK_SECONDS = 1.0
_LINE_SECONDS = 15.0
"""Time between two lines about an installation where no terminal shows a moving one."""
_STAMP = "clrecon-installed.txt"
_LOG = "clrecon-install.log"


class SetupError(Exception):
    """The environment cannot be made; the message says what to do."""


def program_path(folder: str, name: str) -> str:
    """Return the path of program `name` in the environment `folder`."""
    if os.name == "nt":
        return os.path.join(folder, "Scripts", name + ".exe")
    return os.path.join(folder, "bin", name)


def find_python(checkout: str | os.PathLike[str]) -> str | None:
    """Return the Python of a checkout's environment, that of the tests before that of scripts/run.py; None without."""
    for folder in (".venv-test", ".venv"):
        python = program_path(os.path.join(os.path.abspath(checkout), folder), "python")
        if os.path.exists(python):
            return python
    return None


def _wanted_stamp(extras: str) -> str:
    parts = [f"python {sys.version}", f"base {sys.base_prefix}", f"project {ROOT}", f"extras {extras}"]
    for name in ("setup.cfg", "pyproject.toml"):
        with open(os.path.join(ROOT, name), encoding="utf-8") as file:
            parts.append(file.read())
    return "\n".join(parts)


def _is_finished(folder: str, stamp: str, program: str) -> bool:
    try:
        with open(os.path.join(folder, _STAMP), encoding="utf-8") as file:
            # exists() follows links: it is also false when the Python behind the environment is gone
            return (
                file.read() == stamp
                and os.path.exists(program_path(folder, "python"))
                and os.path.exists(program_path(folder, program))
            )
    except OSError:
        return False


def ensure_environment(
    name: str, extras: str = "", program: str = "clrecon", compiled: bool = True, megabytes: int = 0
) -> str:
    """Return the folder of a finished environment; make it if it is missing.

    name: Folder in the project, such as ``.venv``.
    extras: Extras of setup.cfg to install, such as ``test,dev``.
    program: A program of the finished environment.
    compiled: Whether pip compiles all modules, half a minute for the tests' ten thousand; else each is at its first
    import.
    megabytes: Size of the finished environment on the disk, for messages; 0: not said.
    """
    folder = os.path.join(ROOT, name)
    stamp = _wanted_stamp(extras)
    if _is_finished(folder, stamp, program):
        return folder
    with _locked(folder + ".lock"):
        if not _is_finished(folder, stamp, program):  # another process may have made it while this one waited
            _make(folder, stamp, extras, compiled, megabytes)
    return folder


@contextmanager
def _locked(path: str) -> Iterator[None]:
    """Hold the lock file `path`; the system releases it when the process dies."""
    try:
        file = open(path, "a+b")  # noqa: SIM115 (closed below)
    except OSError as error:
        raise SetupError(f"the environment goes beside setup.cfg, but {ROOT} cannot be written: {error}") from error
    try:
        _wait_for_lock(file.fileno())
        yield
    finally:
        file.close()


def _wait_for_lock(descriptor: int) -> None:
    import time

    told = False
    while True:
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError:
            if not told:
                _say("another start is installing clrecon, waiting for it")
                told = True
            time.sleep(0.2)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _check_venv() -> None:
    """Refuse a Python without venv or ensurepip, which Debian and its relatives package separately."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        version = f"{sys.version_info[0]}.{sys.version_info[1]}"
        raise SetupError(
            f"this Python ({sys.executable}) cannot make environments: its module {error.name} is missing.\n"
            f"On Debian and Ubuntu: sudo apt install python3-venv   (or python{version}-venv), then start again.\n"
            "Elsewhere install Python 3.10 or newer from python.org."
        ) from error


def _make(folder: str, stamp: str, extras: str, compiled: bool, megabytes: int) -> None:
    import subprocess

    _check_venv()
    size = f", about {megabytes / 1000:.1f} GB on the disk" if megabytes else ""
    _say(f"making {os.path.basename(folder)} and installing clrecon (a minute or two, once{size})")
    try:
        os.unlink(os.path.join(folder, _STAMP))
    except FileNotFoundError:
        pass
    # -m venv in a separate process: this one may run in an environment, or without a writable home
    made = subprocess.run([sys.executable, "-m", "venv", "--clear", folder], capture_output=True, text=True)
    if made.returncode:
        raise SetupError(f"python -m venv failed:\n{(made.stdout + made.stderr).strip()}")
    target = f"{ROOT}[{extras}]" if extras else ROOT
    pip = [program_path(folder, "python"), "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
    # The pip that comes with Python 3.11 chooses versions in 39 s of the processor, pip 26 in 15.  Where there is no
    # newer one to be had, the old one does it.
    subprocess.run([*pip, "--quiet", "--retries", "0", "--upgrade", "pip"], capture_output=True)
    command = [*pip, "--progress-bar", "off", *([] if compiled else ["--no-compile"]), "--editable", target]
    log = os.path.join(folder, _LOG)
    code = _run_logged(command, log, folder, megabytes)
    if code:
        raise SetupError("\n".join([*_last_words(log), f"(pip's whole output: {log})"]))
    with open(os.path.join(folder, _STAMP + ".new"), "w", encoding="utf-8") as file:
        file.write(stamp)
    os.replace(os.path.join(folder, _STAMP + ".new"), os.path.join(folder, _STAMP))


def _last_words(log: str) -> list[str]:
    """Return why pip failed: no network, else its errors or last lines, where long lists of versions are cut."""
    import re

    with open(log, encoding="utf-8") as file:
        lines = [line.rstrip() for line in file if line.strip()]
    broken = [re.sub(r".*\] |'\).*", "", line) for line in lines if "connection broken by" in line]
    if broken and any("from versions: none" in line for line in lines):
        return [
            f"pip cannot reach the package index: {broken[-1]:.100}.",
            "The first start needs a network, later ones do not. Behind a proxy set HTTPS_PROXY.",
        ]
    errors = [line for line in lines if "error:" in line.lower()]
    return ["pip failed:", *(line[:200] for line in (errors or lines)[-8:])]


def _run_logged(command: list[str], log: str, folder: str, megabytes: int) -> int:
    """Run `command` with its output in the file `log`, and show how far it is.

    A terminal shows one moving line, anything else a line every `_LINE_SECONDS`: seconds, size of the folder, and the
    last words of the command.
    """
    import subprocess
    import threading
    import time

    shows = sys.stderr.isatty()
    start = told = time.monotonic()
    words = ""

    def keep(lines: Iterator[str], file: TextIO) -> None:
        nonlocal words
        for line in lines:
            file.write(line)
            words = line.strip() or words

    with (
        open(log, "w", encoding="utf-8") as file,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process,
    ):
        assert process.stdout is not None
        reader = threading.Thread(target=keep, args=(process.stdout, file), daemon=True)
        reader.start()
        while reader.is_alive():
            reader.join(_TICK_SECONDS)
            now = time.monotonic()
            if reader.is_alive() and (shows or now - told >= _LINE_SECONDS):
                told = now
                of = f" of about {megabytes:,}" if megabytes else ""
                line = f"{now - start:4.0f} s, {_size_mb(folder):,.0f}{of} MB" + (f": {words}" if words else "")
                if shows:
                    print("\r\033[K  " + line[: _columns() - 3], end="", file=sys.stderr, flush=True)
                else:
                    _say(line[:100])
    if shows:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
    if process.returncode == 0:
        _say(f"installed in {time.monotonic() - start:.0f} s: {_size_mb(folder):,.0f} MB in {os.path.basename(folder)}")
    return process.returncode


def _size_mb(folder: str) -> float:
    """Return the size of the files in a folder; what vanishes meanwhile counts nothing."""
    total = 0
    for where, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(where, name)).st_size
            except OSError:
                pass
    return total / 1e6


def _columns() -> int:
    try:
        return os.get_terminal_size(2).columns
    except OSError:
        return 80
