"""What takes long to make is made once for all processes of a session."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path


def make_once(folder: Path, name: str, make: Callable[[Path], object]) -> Path:
    """The path `name` in a folder that processes share; who asks first has `make` write it, a file or a folder."""
    made = folder / name
    if not made.exists():
        with tempfile.TemporaryDirectory(dir=folder) as own:
            make(Path(own) / name)
            try:
                os.rename(Path(own) / name, made)
            except OSError:
                if not made.exists():  # else another process was first
                    raise
    return made
