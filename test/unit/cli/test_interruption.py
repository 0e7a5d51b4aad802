"""A signal ends a command, also where its interruption gets lost; cleaning up is left in peace."""

import os
import signal
import time

import pytest

from geoorbit_ros.cli.signals import LOST_S, Interrupted, Interruption


class Careless:
    """A library that takes every exception for "not there", as some written in C do."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def look_up(self) -> None:
        try:
            os.kill(os.getpid(), self.number)
            for _ in range(1000):
                time.monotonic()
        except BaseException:
            return
        pytest.fail("the signal came too late")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_that_gets_lost_comes_again(number: signal.Signals) -> None:
    ended = False
    with Interruption(ends_process=False) as interruption:
        try:
            Careless(number).look_up()
            assert interruption.came
            deadline = time.monotonic() + 60.0
            while time.monotonic() < deadline:
                pass
        except Interrupted:
            ended = True
    assert ended
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_cleaning_up_is_not_interrupted_again() -> None:
    cleaned = False
    with Interruption(ends_process=False) as interruption:
        try:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60.0)
            finally:
                end = time.monotonic() + 3.0 * LOST_S
                while time.monotonic() < end:
                    pass
                cleaned = True
        except Interrupted:
            interruption.over()
        end = time.monotonic() + 2.0 * LOST_S
        while time.monotonic() < end:
            pass
    assert cleaned


def test_what_a_library_makes_of_an_interruption_ends_with_it_and_other_errors_do_not() -> None:
    with Interruption(ends_process=False):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60.0)
        except Interrupted:
            raise RuntimeError("the library's own") from None
    with pytest.raises(RuntimeError, match="a defect"), Interruption(ends_process=False):
        raise RuntimeError("a defect")
