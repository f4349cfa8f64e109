"""What one case of the fuzzer is, what came of it, and how that is judged."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from clrecon.errors import ClreconError

TIME_LIMIT_S = 5.0
"""Processor time of one case of a few kB, its processes included: on a busy machine nothing is late for that alone.
The parent ends a worker that takes six times as much."""
MEMORY_LIMIT_BYTES = 256 * 1024 * 1024
"""What one case may take beyond what its process has: a thousand times its input, and the codecs that it loads."""
SECRET = "SECRET"
"""In the patient's name and number of all input: no answer may hold it."""

GOOD = {
    "same": "the result of the unharmed input",
    "warned": "another result, with a warning",
    "agreed": "another result that nothing in the input contradicts",
    "refused": "one line, and the exit code of its error",
}
FAULTS = {
    "silent": "another result without a warning, though the input contradicts itself",
    "foreign": "an exception that is not clrecon's, or more than one line",
    "crash": "the process died",
    "hang": "more processor time than the limit, or no answer at all",
    "memory": "more memory than the limit",
    "noise": "words on the console that are not clrecon's",
    "secret": "patient data in an answer",
    "files": "output half written, left behind or lost",
}


@dataclass(frozen=True)
class Answer:
    """What clrecon made of an input: digests by name, its warnings, and all it said."""

    content: dict[str, str]
    warnings: tuple[str, ...] = ()
    said: str = ""


@dataclass(frozen=True)
class Trial:
    """One harmed input.

    words: What was harmed, and how.
    run: Reads it; raises what clrecon raises.
    unharmed: The answer without harm.
    contradicted: Given the answer, True if its difference to `unharmed` needs a warning.
    limit_s: Of processor time.
    """

    words: str
    run: Callable[[], Answer]
    unharmed: Answer
    contradicted: Callable[[Answer], bool]
    limit_s: float = TIME_LIMIT_S
    limit_bytes: int = MEMORY_LIMIT_BYTES


@dataclass(frozen=True)
class Outcome:
    """The class of an outcome, of GOOD or FAULTS, and the words for it."""

    kind: str
    trial: str
    text: str = ""
    seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


class WrongOutcome(Exception):
    """Raised by ``Trial.run`` where it sees a fault itself: its kind and the words."""

    def __init__(self, kind: str, text: str):
        super().__init__(text)
        self.kind = kind


def digest(data: Any) -> str:
    """Hash of an array's or a file's bytes."""
    return hashlib.sha256(bytes(memoryview(data).cast("B"))).hexdigest()[:16] if len(data) else "empty"


def judge_answer(trial: Trial, answer: Answer) -> tuple[str, str]:
    """Return the kind of outcome of an answer, and the words."""
    if SECRET in answer.said:
        return "secret", answer.said[:500]
    new = [text for text in answer.warnings if text not in trial.unharmed.warnings]
    if answer.content == trial.unharmed.content:
        return "same", ""
    if new:
        return "warned", new[0]
    if trial.contradicted(answer):
        changed = {**trial.unharmed.content, **answer.content}
        return "silent", ", ".join(
            f"{name} was {trial.unharmed.content.get(name)}, is {answer.content.get(name)}"
            for name in changed
            if trial.unharmed.content.get(name) != answer.content.get(name)
        )
    return "agreed", ""


def judge_error(error: ClreconError) -> tuple[str, str]:
    """Return the kind of outcome of a refusal, and the words."""
    text = str(error)
    if SECRET in text:
        return "secret", text
    if "\n" in text or not text.isprintable() or not 0 < len(text) < 5000:
        return "foreign", f"no single line: {text!r:.500}"
    return "refused", text


@dataclass
class Judge:
    """Runs trials one after the other in this process; what they print lands in a file of its own."""

    printed: Any = field(default_factory=tempfile.TemporaryFile)

    def judge(self, trial: Trial) -> Outcome:
        """Run a trial."""
        before, start, worked = _forget_peak(), time.monotonic(), _processor_s()
        with self._listening(), warnings.catch_warnings():
            warnings.simplefilter("always")
            try:
                kind, text = judge_answer(trial, trial.run())
            except ClreconError as error:
                kind, text = judge_error(error)
            except WrongOutcome as wrong:
                kind, text = wrong.kind, str(wrong)
            except MemoryError as error:
                kind, text = "memory", repr(error)
            except Exception:
                kind, text = "foreign", traceback.format_exc(limit=-4)
        seconds, worked = time.monotonic() - start, _processor_s() - worked
        noise, taken = self._heard(), _peak_bytes() - before
        if kind in GOOD and noise:
            kind, text = "noise", noise
        if kind in GOOD and taken > trial.limit_bytes:
            kind, text = "memory", f"{taken} bytes"
        if kind in GOOD and worked > trial.limit_s:
            kind, text = "hang", f"{worked:.1f} s of processor time"
        return Outcome(kind, trial.words, text[:2000], round(seconds, 4))

    def _listening(self) -> _Redirected:
        self.printed.seek(0)
        self.printed.truncate()
        return _Redirected(self.printed.fileno())

    def _heard(self) -> str:
        self.printed.seek(0)
        return str(self.printed.read(2000).decode(errors="replace"))


class _Redirected:
    """Both streams of the process, libraries in C among them, go to a file."""

    def __init__(self, file: int):
        self.file = file

    def __enter__(self) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        self.kept = os.dup(1), os.dup(2)
        os.dup2(self.file, 1)
        os.dup2(self.file, 2)

    def __exit__(self, *_: object) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, kept in enumerate(self.kept, start=1):
            os.dup2(kept, number)
            os.close(kept)


def _processor_s() -> float:
    """Processor time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def _peak_bytes() -> int:
    """Largest resident size since `_forget_peak`; 0 where the system does not say."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 0


def _forget_peak() -> int:
    """Start the peak anew; returns where it starts."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass
    return _peak_bytes()
