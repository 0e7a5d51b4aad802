"""The process that trains beside a node."""

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool

import pytest

from geoorbit_ros.learning.processes import NICENESS, BackgroundProcess

LIMIT_S = 60.0


@pytest.fixture
def background() -> Iterator[BackgroundProcess]:
    process = BackgroundProcess()
    yield process
    process.kill()


def test_it_gives_way_and_when_killed_is_replaced(background: BackgroundProcess) -> None:
    first = background.submit(os.getpid).result(LIMIT_S)
    assert first != os.getpid()
    assert background.submit(os.nice, 0).result(LIMIT_S) == NICENESS
    unfinished = background.submit(time.sleep, LIMIT_S)
    os.kill(first, signal.SIGKILL)
    with pytest.raises(BrokenProcessPool):
        unfinished.result(LIMIT_S)
    assert background.submit(os.getpid).result(LIMIT_S) not in (first, os.getpid())


def test_a_terminals_ctrl_c_is_for_the_process_that_it_works_for(
    background: BackgroundProcess,
) -> None:
    blocked = background.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result(LIMIT_S)
    assert blocked >= {signal.SIGINT, signal.SIGTERM}
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & {signal.SIGINT, signal.SIGTERM}
