"""Odd options of the command line, in this process, and odd environments, in processes of their own."""

from __future__ import annotations

import argparse
import functools
import json
import os
import random
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path

from trials import MEMORY_LIMIT_BYTES, Answer, Trial, WrongOutcome, digest

from clrecon.cli.common import Parser, add_common
from clrecon.cli.main import COMMANDS, main
from clrecon.errors import ClreconError

EXIT_CODES = (0, 2, 3, 4, 5, 6, 8)
ODD = [
    "", " ", "--", "-", "-1", "0", "-0", "1", "2", "0.5", "1e400", "1e200", "-1e200", "nan", "inf", "-inf", "9" * 400,
    "1,2", "1,2,3", "-1,2,3", "1:2", "2:1", ":", ",", "1,,2", "\u0661", "\u00bd", "a", "A=1", "=", "a=b,c=d",
    "\x1b[31m", "x\ny", "../../x", "/dev/null", "/dev/full", "/nonexistent/x", ".", "~", "%s", "{}", "x" * 5000, "all",
    "none", "auto", "300", "bone", "png", "500MB", "1GiB", "0B", "64x64", "0x0", "1x99999999", "0,0", "\udcff",
    "eps=2,min=3", "eps=1e-9", "min=plane+1", "largest", "largest:2", "min:3", "seed:1,2,3", "no-sheets",
    "grid,bilateral", "-500,900", "1e-7", "1e4", "0,0,0", "label:1",
    "label:", "i-mc", "g-mc", "skimage", "golden",
    "L4-L5", "L5-L1", "C1-L5", "T12,L1", "2-3", "60",
]  # fmt: skip
UNTRIED = {"bench", "selftest", "demo", "completion"}
"""Commands that take seconds each; their options are tried by the tests of the command line."""
NEVER = ("-h", "--help", "--help-all", "--debug")
COMMAND_LIMIT_S = 20.0
"""Processor time of a command: all kernels of a picture are built in 7 s, once."""
LIBRARIES_BYTES = 256 * 1024 * 1024
"""What the first command of a process takes for drivers and VTK, whatever its input: it took 132 MB with kernels that
are kept, and 307 MB where PoCL's compiler was loaded to build them."""
PROCESS_LIMIT_S = 60.0
"""Processor time of a process that builds all its kernels."""
PROCESS_WAIT_S = 240.0
"""Time after which a process is ended, on a machine however busy."""


@functools.cache
def actions(command: str) -> list[argparse.Action]:
    """The options of a command, as its parser has them."""
    parser = Parser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    add_common(parser)
    return [action for action in parser._actions if action.option_strings and action.option_strings[0] not in NEVER]


@functools.cache
def small_ct() -> Path:
    """A series that every command handles in a moment."""
    folder = Path(tempfile.mkdtemp(prefix="clrecon-fuzz-")) / "ct"
    if main(["phantom", str(folder), "--kind", "sphere", "--size", "16", "--slices", "12", "-q"]):
        raise RuntimeError("the small series was not written")
    return folder


def draw_arguments(chance: random.Random, folder: Path) -> list[str]:
    """A command with one to three odd options."""
    command = chance.choice([name for name in COMMANDS if name not in UNTRIED] + ["mesh", "render", "cloud"])
    given = [command]
    if command in ("mesh", "render", "info", "cloud") and chance.random() < 0.97:
        given.append(str(small_ct()))
    if command == "phantom":
        given += [str(folder / "out"), "--size", "12", "--slices", "8"]
    if command == "mesh":
        given += ["-o", str(folder / ("out" + chance.choice([".stl", ".ply", ".vtp", ".glb", ".obj", ".3mf", ".xyz"])))]
    if command == "render":
        given += ["-o", str(folder / "out.png"), "--size", "32x24"]
    if command == "view":  # without a page to write it serves one until somebody ends it
        given += [str(small_ct()), "--html", str(folder / "out.html")]
    if command == "cloud":
        given += ["-o", str(folder / ("out" + chance.choice([".ply", ".vtp", ".npz", ".xyz", ".las", ".stl"])))]
    return given + draw_options(command, chance, chance.randrange(1, 4))


def draw_options(command: str, chance: random.Random, count: int) -> list[str]:
    """Some options of a command, as its parser has them, with odd values."""
    given: list[str] = []
    for action in chance.sample(actions(command), count):
        name = chance.choice(action.option_strings)
        if action.nargs == 0:
            given.append(name)
            continue
        pool = [str(choice) for choice in action.choices or _named(action)] + ODD
        given += [f"{name}={chance.choice(pool)}"] if chance.random() < 0.6 else [name, chance.choice(pool)]
    return given


def _named(action: argparse.Action) -> list[str]:
    """The values that the help of an option names, as often as odd ones are drawn otherwise."""
    named = str(action.metavar or "").split("|")
    return named * (len(ODD) // (2 * len(named))) if len(named) > 1 else []


def options_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """One call of `main`."""
    given = draw_arguments(chance, folder)

    def run() -> Answer:
        return call_main(given, folder)

    unharmed = Answer({"exit": "0"})
    words = " ".join(f"{text!r:.100}" for text in given)
    limit_bytes = MEMORY_LIMIT_BYTES + LIBRARIES_BYTES
    return Trial(words, run, unharmed, lambda answer: False, COMMAND_LIMIT_S, limit_bytes)


def call_main(given: list[str], folder: Path) -> Answer:
    """Run a command as a user would, hold its streams, and look at its files."""
    before = os.getcwd()
    os.chdir(folder)
    with tempfile.TemporaryFile("w+", errors="replace") as out, tempfile.TemporaryFile("w+", errors="replace") as err:
        kept = os.dup(1), os.dup(2)
        try:
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            code = main(given)
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            os.chdir(before)
            for file in kept:
                os.close(file)
        said = [_content(out), _content(err)]
    check_call(given, code, *said)
    check_files(code, [path for path in folder.rglob("*") if "ct" not in path.parts])
    if code not in (0, 8):
        raise ClreconError(said[1].strip().splitlines()[-1])
    return Answer({"exit": str(code)}, said="\n".join(said))


def _content(stream: object) -> str:
    stream.seek(0)  # type: ignore[attr-defined]
    return str(stream.read())  # type: ignore[attr-defined]


_DRIVERS_WORDS = ("MESA: warning: Treating load_kernel_arg in control flow as uniform",)
"""Said by Mesa 22.3 when it compiles a kernel that follows rays; the self-test passes there.  Not hidden from users: a
driver's doubt of its own results is theirs to know."""


def check_call(given: list[str], code: int, out: str, err: str) -> None:
    """Raise `WrongOutcome` where code and streams are not what they shall be."""
    if code < 0:
        raise WrongOutcome("crash", f"signal {-code}; {err[-500:]}")
    if code not in EXIT_CODES or "unexpected error" in err or "Traceback" in err:
        raise WrongOutcome("foreign", f"exit {code}: {err[-1500:]}")
    errors = [line for line in err.splitlines() if line.startswith("clrecon: error:")]
    if code not in (0, 8) and len(errors) != 1 and "--strict" not in given:
        raise WrongOutcome("foreign", f"exit {code} with {len(errors)} error lines: {err[-500:]}")
    foreign = [line for line in err.splitlines() if line and not line.startswith(("clrecon:", " ", *_DRIVERS_WORDS))]
    if foreign and not {"-v", "--verbose", "-"} & set(given):  # with an output on stdout, words go to stderr
        raise WrongOutcome("noise", "\n".join(foreign)[:500])
    flags = given[: given.index("--")] if "--" in given else given
    if "--json" in flags and out:
        try:
            json.loads(out)
        except ValueError:
            raise WrongOutcome("noise", f"no JSON: {out[:300]!r}") from None


def check_files(code: int, found: list[Path]) -> None:
    """Raise `WrongOutcome` where a refused command left something behind."""
    left = [path.name for path in found if path.name.startswith((".", "tmp")) or (code in (2, 3, 4, 5, 6))]
    if left:
        raise WrongOutcome("files", f"exit {code} and left: {', '.join(left)[:300]}")


# --- environments ---
def _paths(chance: random.Random, folder: Path) -> str:
    file = folder / "file"
    file.write_bytes(b"x")
    closed = folder / "closed"
    closed.mkdir(mode=0o500, exist_ok=True)
    shared = folder / "shared"
    shared.mkdir(exist_ok=True)
    shared.chmod(0o777)
    link = folder / "link"
    if not link.is_symlink():
        link.symlink_to("/nonexistent")
    return chance.choice(
        ["", " ", "/nonexistent", "relative", "/dev/null", "/proc", *map(str, (file, closed, shared, link))]
    )


PLACES = ["HOME", "XDG_CACHE_HOME", "POCL_CACHE_DIR", "TMPDIR", "XDG_CONFIG_HOME"]
VALUES = {
    "PYOPENCL_CTX": ["0", "1", "0:0", "9", "x", "", "oclgrind"],
    "PYOPENCL_NO_CACHE": ["1", ""],
    "CLRECON_DEVICE": ["0", "9", "x", "", "cpu", "gpu", " "],
    "LANG": ["C", "de_DE.UTF-8", "xx"],
    "LC_ALL": ["C", "POSIX", "de_DE.UTF-8", "\x01"],
    "PYTHONIOENCODING": ["ascii", "latin-1", "utf-16"],
    "COLUMNS": ["0", "-1", "x", "10", "99999"],
    "TERM": ["dumb", "", "xterm"],
    "NO_COLOR": ["1"],
    "OMP_NUM_THREADS": ["0", "1", "x"],
    "POCL_DEVICES": ["", "none", "pthread", "basic"],
    "POCL_MAX_PTHREAD_COUNT": ["1", "0", "-1"],
    "OCL_ICD_VENDORS": ["/nonexistent", "", "/dev/null"],
    "RUSTICL_ENABLE": ["llvmpipe", "x", ""],
    "PYTHONWARNINGS": ["error", "default"],
    "TZ": ["Asia/Kolkata", "x"],
}


def environment_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """A process in an odd environment: the same mesh, or a refusal."""
    changed = {name: _paths(chance, folder) for name in chance.sample(PLACES, chance.randrange(0, 3))}
    names = chance.sample(list(VALUES), chance.randrange(0 if changed else 1, 3))
    changed |= {name: chance.choice(VALUES[name]) for name in names}
    mask = chance.choice([None, None, 0o000, 0o777, 0o277])

    def run() -> Answer:
        return call_process(changed, mask, folder)

    words = ", ".join(f"{name}={value!r}" for name, value in changed.items()) + (
        f", umask {mask:03o}" if mask is not None else ""
    )
    return Trial(words, run, plain_mesh(), lambda answer: True, PROCESS_LIMIT_S)


def call_process(changed: dict[str, str], mask: int | None, folder: Path) -> Answer:
    """Make a mesh of the small series in a process of its own."""
    target = folder / "mesh.stl"
    given = ["mesh", str(small_ct()), "-o", str(target), "--hu", "300"]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "clrecon", *given],
            env={**os.environ, **changed},
            umask=-1 if mask is None else mask,
            capture_output=True,
            encoding=changed.get("PYTHONIOENCODING", "utf-8"),
            errors="replace",
            timeout=PROCESS_WAIT_S,
            cwd=folder,
        )
    except subprocess.TimeoutExpired:
        raise WrongOutcome("hang", f"no end in {PROCESS_WAIT_S:.0f} s") from None
    check_call(given, done.returncode, done.stdout, done.stderr)
    check_files(done.returncode, list(folder.glob("mesh*")))
    if done.returncode:
        raise ClreconError(done.stderr.strip().splitlines()[-1])
    if not target.stat().st_mode & 0o400:
        target.chmod(0o600)
    warned = tuple(line for line in done.stderr.splitlines() if "warning" in line)
    return Answer({"mesh": digest(target.read_bytes())}, warned, done.stdout + done.stderr)


@functools.cache
def plain_mesh() -> Answer:
    """The mesh of the small series in this environment."""
    with tempfile.TemporaryDirectory() as place:
        return call_process({}, None, Path(place))
