"""Logging for batches: what is found and chosen, never names of files or other text that people write.

Python's own `logging` is used, under the names of the modules: ``clrecon...``.  Silent unless the caller listens.
DEBUG: findings, and the time of each stage.  INFO: choices, written files, and unusual ways of working.  WARNING: only
the warnings of the report.  Importing `logging` takes milliseconds: only modules that are loaded for work have a
logger, not `import clrecon` and not the help of the command line.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

logging.getLogger("clrecon").addHandler(logging.NullHandler())  # otherwise Python writes warnings to stderr


def get_logger(name: str) -> logging.Logger:
    return logging.getLogger(name)


def log_warnings(log: logging.Logger, warnings: Iterable[str], known: Iterable[str] = ()) -> None:
    """Log the warnings of a report, except those that are `known`, which are already logged."""
    logged = set(known)
    for text in warnings:
        if text not in logged:
            log.warning("%s", text)
