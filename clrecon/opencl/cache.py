"""Kept kernels: the folders in which clrecon and drivers keep built programs, and whether they can be trusted.

What lies in these folders is loaded and executed.  Each is therefore checked before the driver is loaded: it belongs to
this user, nobody else can write to it or put another one in its place, it is no link, and it has room.  A folder that
fails is not used: PoCL, which cannot do without one, gets a temporary folder that is removed at the end of the process;
the others keep nothing.

Programs of drivers that keep none lie in a folder of clrecon.  A file is named by a hash of everything that its binary
depends on, and contains that name and a hash of name and binary together: a program is built again if its file was cut,
changed, or takes the place of another.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import stat
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from clrecon.errors import DeviceError
from clrecon.system.log import get_logger

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

ROOM_BYTES = 64 << 20
"""Room that a folder of built kernels must have: all of a device take 12 MB; PoCL ends the process on a full disk."""

_LONGEST_FILE_BYTES = 1 << 20
"""Size that files of built kernels must be allowed to have: the longest has 0.2 MB."""

_OWN = "clrecon"
"""Folder within PoCL's for clrecon alone, so that each file in it can be accounted for (`clrecon.opencl.pocl`)."""

_MESA_OFF = {"MESA_SHADER_CACHE_DISABLE": "true", "MESA_GLSL_CACHE_DISABLE": "true"}
"""Switches off Mesa's cache (before 22.1 by the last name): a thread writes to it, even into a folder being removed."""

_RELATIVE = "is no absolute path"
"""Libraries differ in what they make of such a folder: pytools looks for one elsewhere, others take it as it is."""

_UNKNOWN_OWNER = 65534
"""Owner that a user namespace shows for everything of users outside of it, the system's own folders included."""


class Caches(NamedTuple):
    """Where this process keeps built kernels.

    pocl: Folder of PoCL, only for kernels of clrecon.
    is_lasting: `pocl` is there for the next process too.
    binaries: Folder of our own; None where nothing can be kept.
    warnings: What the user should know, at most one text.
    refusal: Why PoCL cannot build in `pocl`; empty if it can.
    """

    pocl: Path
    is_lasting: bool
    binaries: Path | None
    warnings: tuple[str, ...]
    refusal: str


def make_private(folder: Path) -> None:
    """Make a folder and its parents, each for this user alone whatever the umask; those that are there stay."""
    if not os.path.lexists(folder):
        make_private(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)
        folder.chmod(0o700)


def find_fault(folder: Path) -> str:
    """Return why built kernels in `folder`, made if absent, cannot be trusted, as the end of a sentence, or ""."""
    if not folder.is_absolute():
        return _RELATIVE
    try:
        make_private(folder)
        state = folder.lstat()
        if stat.S_ISLNK(state.st_mode):
            return "is a link to another place"
        if not stat.S_ISDIR(state.st_mode):
            return "is no folder"
        return _fault_of_owner(folder, state) or _fault_of_room(folder)
    except OSError:
        return "cannot be written"


def _fault_of_room(folder: Path) -> str:
    """Return why nothing can be kept in a folder, which is made where it is not there."""
    if not folder.is_absolute():
        return _RELATIVE
    try:
        make_private(folder)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 12))
        room = shutil.disk_usage(folder).free
    except OSError:
        return "cannot be written"
    if room < ROOM_BYTES:
        return f"has room for {room >> 20} MiB, and {ROOM_BYTES >> 20} MiB are needed"
    return ""


def _fault_of_owner(folder: Path, state: os.stat_result) -> str:
    """Return who else can put files into a folder."""
    if not hasattr(os, "getuid"):  # Windows: the profile folder belongs to the user
        return ""
    if state.st_uid != os.getuid():
        return "belongs to another user"
    if state.st_mode & 0o022:
        return f"can be written by other users (mode {stat.S_IMODE(state.st_mode):04o}; chmod go-w ends that)"
    for parent in folder.resolve().parents:
        above = parent.stat()
        if above.st_uid not in (0, os.getuid(), _UNKNOWN_OWNER):
            return "lies in a folder of another user"
        if above.st_mode & 0o002 and not above.st_mode & stat.S_ISVTX:
            return "lies in a folder that other users can write to"
    return ""


def _cache_home() -> tuple[Path, str]:
    """Return the folder of all caches of this user, and its name for messages, which name no folder of the user."""
    named = os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named), "XDG_CACHE_HOME"
    if os.environ.get("HOME") == "":  # the root folder for Python, the home of the user table for pytools
        return Path(".cache"), "~/.cache"
    return Path(os.path.expanduser("~/.cache")), "~/.cache"


def _pocl_folder(home: Path, home_name: str) -> tuple[Path, str, str]:
    """Return PoCL's folder for clrecon, its name for messages, and what is wrong with it."""
    named = os.environ.get("POCL_CACHE_DIR")
    if named is None:
        folders, name = (home / "pocl", home / "pocl" / _OWN), f"{home_name}/pocl"
    elif not named.strip():  # PoCL ends the process
        return home / "pocl" / _OWN, "POCL_CACHE_DIR", "is set to nothing"
    else:
        folder, name = Path(os.path.abspath(named)), "POCL_CACHE_DIR"
        folders = (folder.parent, folder) if folder.name == _OWN else (folder, folder / _OWN)
    return folders[1], name, next(filter(None, map(find_fault, folders)), "")


def _remove_tree(folder: str) -> None:
    """Remove a folder into which threads of a driver may still be writing, so that a first attempt may fail."""
    for pause in (0.0, 0.01, 0.03, 0.1, 0.3):
        time.sleep(pause)
        shutil.rmtree(folder, ignore_errors=True)
        if not os.path.lexists(folder):
            return


@cache
def prepare_caches() -> Caches:
    """Check the folders of built kernels, once in a process, and set the environment of the drivers accordingly."""
    home, home_name = _cache_home()
    if os.environ.get("XDG_CACHE_HOME") == "":  # Mesa would make a folder without a name, and complain
        del os.environ["XDG_CACHE_HOME"]
    folder = home / _OWN
    faults = _find_faults(home, home_name, folder)
    pocl, pocl_name, of_pocl = _pocl_folder(home, home_name)
    if of_pocl and not (home_name in faults and pocl_name.startswith(home_name)):
        faults[pocl_name] = of_pocl
    if home_name in faults or f"{home_name}/pytools" in faults:
        os.environ["PYOPENCL_NO_CACHE"] = "1"
    if home_name in faults or f"{home_name}/mesa_shader_cache" in faults:
        os.environ.update(_MESA_OFF)
    fault_list = "; ".join(f"{name} {fault}" for name, fault in faults.items())
    warnings = (f"caches of built kernels are not used, every process builds them anew: {fault_list}",)
    refusal = ""
    if of_pocl:
        pocl, refusal = _temporary_folder(pocl)
    os.environ["POCL_CACHE_DIR"] = str(pocl)
    keeps = home_name not in faults and f"{home_name}/{_OWN}" not in faults
    return Caches(pocl, not of_pocl, folder / "kernels" if keeps else None, warnings if faults else (), refusal)


def _find_faults(home: Path, home_name: str, folder: Path) -> dict[str, str]:
    """Return what is wrong with the folders in the cache home, by their names for messages."""
    fault = _fault_of_room(home)
    if fault:
        return {home_name: fault}
    faults = {f"{home_name}/{_OWN}": find_fault(folder) or find_fault(folder / "kernels")}
    faults[f"{home_name}/pytools"] = find_fault(home / "pytools")  # pickles of pyopencl
    mesa = home / "mesa_shader_cache"
    faults[f"{home_name}/mesa_shader_cache"] = find_fault(mesa) if os.path.lexists(mesa) else ""
    return {name: fault for name, fault in faults.items() if fault}


def _temporary_folder(refused: Path) -> tuple[Path, str]:
    """Make the folder of PoCL for this process alone; return it, and why it cannot be used."""
    try:
        temporary = tempfile.mkdtemp(prefix="clrecon-")
    except OSError:  # with this folder PoCL shows no device
        return refused, "no temporary folder can be written"
    atexit.register(_remove_tree, temporary)
    folder = Path(temporary) / _OWN
    fault = find_fault(folder)
    return folder, fault and f"the temporary folder {fault}"


def cache_warnings() -> tuple[str, ...]:
    """Return what the user should know about the folders of built kernels, at most one text."""
    return prepare_caches().warnings


def refuse_short_files() -> None:
    """Refuse to build with a driver that ends the process when a file cannot be written."""
    if resource is not None:
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        if limit != resource.RLIM_INFINITY and limit < _LONGEST_FILE_BYTES:
            raise DeviceError(
                f"kernels cannot be built: files may have {limit / 1e6:.2f} MB here (ulimit -f), and the driver's need"
                f" up to {_LONGEST_FILE_BYTES / 1e6:.0f} MB: raise that limit"
            )
    caches = prepare_caches()
    if caches.refusal:
        raise DeviceError(
            f"kernels cannot be built: {'; '.join((*caches.warnings, caches.refusal))}: free some space, or name"
            " another folder with POCL_CACHE_DIR or TMPDIR"
        )


log = get_logger(__name__)

_MAGIC = b"clrecon kernels 2\n"
_MOST_FILES = 512


def binary_key(*parts: str) -> str:
    """Return a hash of everything that a binary depends on: device, driver, options, source."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(str(len(part)).encode() + b":" + part.encode())
    return digest.hexdigest()


def _head(key: str, binary: bytes) -> bytes:
    name = key.encode()
    return _MAGIC + name + hashlib.sha256(name + binary).digest()


def read_binary(key: str) -> bytes | None:
    """Return the binary kept under `key`; None where there is none, or none that can be trusted."""
    folder = prepare_caches().binaries
    if folder is None:
        return None
    try:
        content = (folder / key).read_bytes()
    except OSError:
        return None
    binary = content[len(_head(key, b"")) :]
    if content != _head(key, binary) + binary:
        log.info("a kept binary is damaged: it is built anew and replaced")
        return None
    return binary


def store_binary(key: str, binary: bytes) -> None:
    """Keep `binary` under `key`, whole or not at all, in place of the oldest; a folder that refuses is no error."""
    folder = prepare_caches().binaries
    if folder is None:
        return
    with suppress(OSError):
        handle, name = tempfile.mkstemp(prefix=".new-", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_head(key, binary) + binary)
            os.replace(name, folder / key)
        except OSError:
            os.unlink(name)
            raise
        for path in sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)[:-_MOST_FILES]:
            path.unlink(missing_ok=True)
