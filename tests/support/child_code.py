"""Code in the place of a module that a new interpreter is to run: how a child process crashes, hangs or lies."""

from __future__ import annotations

import os
from pathlib import Path
from textwrap import indent

import pytest


def run_instead(monkeypatch: pytest.MonkeyPatch, folder: Path, module: str, code: str) -> None:
    """Let interpreters started from now on with ``-m module`` run `code`; `folder` is for the file that they import."""
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(
        "import os, sys\n"
        f"if sys.orig_argv[1:3] == ['-m', {module!r}]:\n"
        f"{indent(code, '    ')}\n"
        "    sys.stdout.flush()\n"
        "    os._exit(0)\n",
        encoding="utf-8",
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))))
