"""What a batch may want to find later, in Python's own `logging` under the names of the modules: ``clrecon...``.

Silent unless the caller listens.  DEBUG: what was found and how long each stage took.  INFO: what was chosen, written,
or done in another way than usual.  WARNING: only what the report says as a warning too.  No text holds names of files
or anything else that people write: those may name a patient.

To import `logging` takes milliseconds: only modules that are loaded for work have a logger, not `import clrecon` and
not the help of the command line.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

__all__ = ["get_logger", "log_warnings"]

logging.getLogger("clrecon").addHandler(logging.NullHandler())  # else Python writes warnings to stderr itself


def get_logger(name: str) -> logging.Logger:
    """The logger of a module, by its ``__name__``."""
    return logging.getLogger(name)


def log_warnings(log: logging.Logger, warnings: Iterable[str], known: Iterable[str] = ()) -> None:
    """Say the warnings of a report; not those that are `known`, which the log has already."""
    said = set(known)
    for text in warnings:
        if text not in said:
            log.warning("%s", text)
