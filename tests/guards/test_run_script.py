"""scripts/run.py makes its environment once, says what is wrong where it cannot, and then runs clrecon in it."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from house import ROOT

posix_only = pytest.mark.skipif(os.name == "nt", reason="the stand-in program is a shell script")


def copy_scripts(tmp_path: Path) -> Path:
    project = tmp_path / "a project"
    (project / "scripts").mkdir(parents=True)
    for name in ("setup.cfg", "pyproject.toml", "scripts/run.py", "scripts/_environment.py"):
        shutil.copy(ROOT / name, project / name)
    return project


def run_script(project: Path, *arguments: str, before: str = "") -> subprocess.CompletedProcess[str]:
    """Run scripts/run.py, with the statements `before` executed first in the same process."""
    script = str(project / "scripts" / "run.py")
    code = f"import runpy, sys\n{before}\nsys.path.insert(0, {str(project / 'scripts')!r})\n"
    code += f"sys.argv = [{script!r}, *{list(arguments)!r}]\nrunpy.run_path({script!r}, run_name='__main__')"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def make_finished_environment(project: Path) -> Path:
    """Put a finished environment in place whose clrecon prints its arguments and exits with 5; returns its stamp."""
    code = "import _environment as e; print(e._wanted_stamp(''), end='')"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=project / "scripts", capture_output=True, text=True, check=True
    )
    programs = project / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "python").symlink_to(sys.executable)
    (programs / "clrecon").write_text('#!/bin/sh\necho "called with" "$@"\nexit 5\n')
    (programs / "clrecon").chmod(0o755)
    stamp = project / ".venv" / "clrecon-installed.txt"
    stamp.write_text(done.stdout)
    return stamp


@posix_only
def test_clrecon_of_a_finished_environment_runs_with_the_arguments_and_its_exit_code(tmp_path: Path) -> None:
    project = copy_scripts(tmp_path)
    make_finished_environment(project)
    done = run_script(project, "mesh", "A FOLDER", "-o", "x.stl")
    assert (done.returncode, done.stdout, done.stderr) == (5, "called with mesh A FOLDER -o x.stl\n", "")
    assert not (project / ".venv.lock").exists()  # nothing is installed


@posix_only
def test_run_script_without_arguments_shows_the_help(tmp_path: Path) -> None:
    project = copy_scripts(tmp_path)
    make_finished_environment(project)
    assert run_script(project).stdout == "called with --help\n"


WITHOUT_ENSUREPIP = "sys.modules['ensurepip'] = None"
"""As on a system without its package for virtual environments: stops the installation at its first step."""


@posix_only
@pytest.mark.parametrize("change", ["setup.cfg", "stamp cut", "no stamp", "program gone"])
def test_environment_that_is_changed_or_incomplete_is_installed_again(tmp_path: Path, change: str) -> None:
    project = copy_scripts(tmp_path)
    stamp = make_finished_environment(project)
    if change == "setup.cfg":
        (project / change).write_text((project / change).read_text().replace("numpy >= 1.24", "numpy >= 1.25"))
    elif change == "stamp cut":
        stamp.write_text(stamp.read_text()[:-1])
    elif change == "no stamp":
        stamp.unlink()
    else:
        (project / ".venv" / "bin" / "clrecon").unlink()

    done = run_script(project, before=WITHOUT_ENSUREPIP)

    assert done.returncode == 1
    assert "called with" not in done.stdout


def test_run_script_without_ensurepip_says_what_to_install(tmp_path: Path) -> None:
    done = run_script(copy_scripts(tmp_path), before=WITHOUT_ENSUREPIP)
    assert done.returncode == 1
    assert "sudo apt install python3-venv" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["run.py", "test.py"])
def test_script_under_an_old_python_is_refused_in_one_line(name: str) -> None:
    script = ROOT / "scripts" / name
    code = f"import runpy, sys\nsys.version_info = (3, 9, 2)\nrunpy.run_path({str(script)!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert line.startswith("clrecon needs Python 3.10 or newer")


@posix_only
def test_run_script_says_that_a_project_cannot_be_written(tmp_path: Path) -> None:
    project = copy_scripts(tmp_path)
    (project / ".venv.lock").mkdir()  # for root as for others: not a file that can be opened
    done = run_script(project)
    assert done.returncode == 1
    assert "cannot be written" in done.stderr
    assert "Traceback" not in done.stderr


SLOW_INSTALLATION = """
import sys, time
for step in range(3):
    print("Collecting part", step, flush=True)
    open(sys.argv[1] + f"/part{step}", "wb").write(bytes(1_500_000))
    time.sleep(0.4)
sys.exit(int(sys.argv[2]))
"""


def install_slowly(tmp_path: Path, exit_code: int) -> subprocess.CompletedProcess[str]:
    """Run an installation of 4.5 MB in three parts, its output logged, and its progress printed each tenth second."""
    folder = tmp_path / "env"
    folder.mkdir()
    (tmp_path / "slow.py").write_text(SLOW_INSTALLATION)
    command = [sys.executable, str(tmp_path / "slow.py"), str(folder), str(exit_code)]
    source = (
        "import sys, _environment as e\n"
        "e._TICK_SECONDS = e._LINE_SECONDS = 0.1\n"
        f"sys.exit(e._run_logged({command}, {str(tmp_path / 'log')!r}, {str(folder)!r}, 1200))"
    )
    return subprocess.run([sys.executable, "-c", source], cwd=ROOT / "scripts", capture_output=True, text=True)


def test_installation_prints_its_seconds_megabytes_and_last_line(tmp_path: Path) -> None:
    *progress, last = install_slowly(tmp_path, exit_code=0).stderr.splitlines()
    assert re.fullmatch(r" +\d+ s, \d of about 1,200 MB(: Collecting part \d)?", progress[0])
    assert any("2 of about 1,200 MB" in line for line in progress)
    assert any("Collecting part 2" in line for line in progress)
    assert re.fullmatch(r"installed in \d+ s: 4 MB in env", last)


def test_installation_that_fails_has_its_exit_code_and_is_not_called_installed(tmp_path: Path) -> None:
    done = install_slowly(tmp_path, exit_code=3)
    assert done.returncode == 3
    assert "installed" not in done.stderr


def test_output_of_an_installation_is_written_to_its_log_alone(tmp_path: Path) -> None:
    assert install_slowly(tmp_path, exit_code=0).stdout == ""
    assert (tmp_path / "log").read_text().splitlines() == [f"Collecting part {step}" for step in range(3)]


RETRYING = (
    "  WARNING: Retrying (Retry(total=0, connect=None)) after connection broken by 'NewConnectionError('<a.B object at"
    " 0x7f>: Failed to establish a new connection: [Errno -3] Temporary failure in name resolution')': /simple/numpy/\n"
)
NO_VERSION = "  ERROR: Could not find a version that satisfies the requirement numpy (from versions: none)\n"


@pytest.mark.parametrize(
    ("log", "first"),
    [
        (RETRYING + NO_VERSION, "pip cannot reach the package index: Temporary failure in name resolution."),
        (RETRYING + "error: no space left on device\n", "pip failed:"),
        (NO_VERSION, "pip failed:"),
    ],
    ids=["no network", "other error after a retry", "no such version"],
)
def test_last_words_of_pip_say_whether_the_network_was_missing(log: str, first: str, tmp_path: Path) -> None:
    (tmp_path / "log").write_text(log)
    last_words = runpy.run_path(str(ROOT / "scripts" / "_environment.py"))["_last_words"]
    assert last_words(str(tmp_path / "log"))[0] == first


@posix_only
def test_hooks_of_commits_run_the_quick_checks_of_the_test_script() -> None:
    """The same programs with the same arguments, which .pre-commit-config.yaml cannot import."""
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    checks = runpy.run_path(str(ROOT / "scripts" / "test.py"))["quick_checks"](".venv-test")
    assert re.findall(r"(?m)^ +- id: (.*)$", hooks) == list(checks)
    assert re.findall(r"(?m)^ +entry: (.*)$", hooks) == [" ".join(command) for command in checks.values()]


STAND_IN = """
import os, sys
ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
class SetupError(Exception): pass
def ensure_environment(*_, **__): return ""
def program_path(_, name): return sys.executable if name == "python" else "true"
"""


@pytest.mark.release
@posix_only
def test_run_of_tests_fails_without_waiting_when_a_test_ends_its_process(tmp_path: Path) -> None:
    """Two processes on a file of tests each, one of which is killed: no waiting for it, and no success."""
    for name, text in {
        "scripts/_environment.py": STAND_IN,
        "test_a.py": "import os\ndef test_one(): os.kill(os.getpid(), 9)\ndef test_two(): assert 1\n",
        **{f"test_b{number}.py": "def test_it(): assert 1\n" for number in range(5)},
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    script = shutil.copy(ROOT / "scripts" / "test.py", tmp_path / "scripts")
    code = f"import os, runpy, sys\nos.cpu_count = lambda: 2\nsys.path.insert(0, {str(tmp_path / 'scripts')!r})\n"
    code += f"sys.argv = ['test.py', '--fast']\nrunpy.run_path({str(script)!r}, run_name='__main__')"
    # The time tells a wait for ever from a busy machine, on which three starts of Python have taken a minute.
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "INTERNALERROR" not in done.stdout
    assert "crashed while running" in done.stdout
    assert "FAILED test_a.py::test_one" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("1 failed")
    assert done.stderr.splitlines()[-1] == "failed: pytest"
