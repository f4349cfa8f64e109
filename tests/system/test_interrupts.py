"""SIGINT that is held back."""

from __future__ import annotations

import signal
import threading

import pytest

from clrecon.system.progress import held_interrupts, take_interrupt

pytestmark = pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals are not held on Windows")


@pytest.fixture
def seen():
    """What a handler for SIGINT saw."""
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    yield came
    signal.signal(signal.SIGINT, before)


def test_a_held_interrupt_is_told_once_and_reaches_no_handler(seen):
    with held_interrupts():
        assert not take_interrupt()
        signal.raise_signal(signal.SIGINT)
        assert take_interrupt()
        assert not take_interrupt()
    assert seen == []


def test_one_that_nobody_took_comes_at_the_end(seen):
    with held_interrupts():
        signal.raise_signal(signal.SIGINT)
        assert seen == []
    assert seen == [signal.SIGINT]


def test_threads_hold_it_back_as_their_parent_does(seen):
    masks: list[set[signal.Signals]] = []
    with held_interrupts():
        thread = threading.Thread(target=lambda: masks.append(set(signal.pthread_sigmask(signal.SIG_BLOCK, ()))))
        thread.start()
        thread.join()
    assert signal.SIGINT in masks[0]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
