#!/usr/bin/env python3
"""Start clrecon from this folder: ``python3 scripts/run.py ARGUMENTS`` is the same as ``clrecon ARGUMENTS``.

The first start makes .venv in this folder and installs clrecon into it, with an OpenCL driver if PyPI has one.
"""

import os
import sys

if sys.version_info < (3, 10):
    sys.exit("clrecon needs Python 3.10 or newer, this is %s (%s)" % (sys.version.split()[0], sys.executable))  # noqa: UP031

from _environment import SetupError, ensure_environment, program_path

_MEGABYTES = 1200
"""Size of .venv on the disk, half of it VTK; see setup.cfg for what needs it."""


def main() -> int:
    try:
        folder = ensure_environment(".venv", compiled=False, megabytes=_MEGABYTES)
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted: the next start installs again", file=sys.stderr)
        return 130
    command = [program_path(folder, "clrecon"), *(sys.argv[1:] or ["--help"])]
    if os.name == "nt":  # Windows has no exec: the shell would not wait for the new process
        import subprocess

        return subprocess.call(command)
    os.execv(command[0], command)


if __name__ == "__main__":
    sys.exit(main())
