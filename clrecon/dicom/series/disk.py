"""Reading folders and starts of many files from a disk that may be slow or hang.

The calls that can hang (listing a folder, opening a file, reading its start) run in threads of their own, for two
reasons.  A network drive that does not answer cannot be interrupted, neither by us nor with Ctrl-C: so the caller waits
in another thread, reports after `NOTICE_S` what it waits for, and gives up after `GIVE_UP_S` with an error that names
it.  The threads are daemons, so that a hanging one does not delay the end of the process.  And where a file takes
longer than `SLOW_FILE_S`, the delay lies in the connection to the disk: then several threads wait at once.  On a warm
cache one thread is fastest, since the parser beside it needs the interpreter's lock.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, SimpleQueue
from time import perf_counter
from typing import Any, TypeVar

from clrecon.dicom.parse.elements import FileStart, read_start
from clrecon.errors import RefusedInputError
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

T = TypeVar("T")

NOTICE_S = 10.0
GIVE_UP_S = 300.0  # long enough for a tape library or a sleeping disk
SLOW_FILE_S = 0.0005
CHUNK = 64
MOST_THREADS = 16


class DiskReader:
    """Reads in separate threads while the caller waits; for use in a ``with`` statement.

    progress: Called by the thread of the caller as ``progress("no answer yet from NAME", done, total)`` where the disk
        hangs.

    touched: Path that was read last, for the message when it hangs.
    """

    def __init__(self, progress: Progress | None = None):
        self._progress = progress
        self._jobs: SimpleQueue[tuple[int, Callable[[], Any]] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[int, Any, BaseException | None]] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._place = (0, 0)
        self.touched = ""

    def __enter__(self) -> DiskReader:
        self._start_threads(1)
        return self

    def __exit__(self, *_: object) -> None:
        for _thread in self._threads:
            self._jobs.put(None)

    def run(self, job: Callable[[], T]) -> T:
        """Run one job and wait for it."""
        result: T = self._run_all([job])[0]
        return result

    def read_starts(self, files: Sequence[str]) -> Iterator[FileStart | OSError]:
        """Yield the start of every file, or the error of reading it, in order; `CHUNK` files are held at a time."""
        for first in range(0, len(files), CHUNK):
            self._place = (first, len(files))
            chunk = files[first : first + CHUNK]
            count = len(self._threads)
            start = perf_counter()
            parts = self._run_all([self._make_job(chunk[part::count]) for part in range(count)])
            if count == 1 and perf_counter() - start > SLOW_FILE_S * len(chunk):
                self._start_threads(MOST_THREADS)
            for place in range(len(chunk)):
                yield parts[place % count][place // count]

    def _make_job(self, files: Sequence[str]) -> Callable[[], list[FileStart | OSError]]:
        def read_all() -> list[FileStart | OSError]:
            found: list[FileStart | OSError] = []
            for file in files:
                self.touched = file
                try:
                    found.append(read_start(file))
                except OSError as error:
                    found.append(error)
            return found

        return read_all

    def _start_threads(self, count: int) -> None:
        while len(self._threads) < count:
            thread = threading.Thread(target=self._work, name="clrecon-disk", daemon=True)
            thread.start()
            self._threads.append(thread)

    def _work(self) -> None:
        while (task := self._jobs.get()) is not None:
            number, job = task
            try:
                self._done.put((number, job(), None))
            except BaseException as error:  # raised again in the caller's thread
                self._done.put((number, None, error))

    def _run_all(self, jobs: Sequence[Callable[[], Any]]) -> list[Any]:
        for task in enumerate(jobs):
            self._jobs.put(task)
        results: list[Any] = [None] * len(jobs)
        for _ in jobs:
            number, result, error = self._wait()
            if error is not None:
                raise error
            results[number] = result
        return results

    def _wait(self) -> tuple[int, Any, BaseException | None]:
        waited, seen = 0.0, self.touched
        while True:
            try:
                return self._done.get(timeout=NOTICE_S)
            except Empty:
                pass
            if self.touched != seen:
                waited, seen = 0.0, self.touched
                continue
            waited += NOTICE_S
            name = escape_text(os.path.basename(self.touched) or self.touched)
            if waited >= GIVE_UP_S:
                raise RefusedInputError(
                    f"{name}: no answer from the disk or network drive for {waited:.0f} s; is it still connected?"
                )
            if self._progress is not None:
                self._progress(f"no answer yet from {name}", *self._place)
