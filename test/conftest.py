"""Fixtures for tests of every kind."""

import signal

import pytest
from hypothesis import settings
from made_up_camera import MadeUpCamera, make_camera

# A shell's background job ignores Ctrl-C, and so would every process the tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run: a red test is the change's doing, not the dice's.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def camera(tmp_path_factory: pytest.TempPathFactory) -> MadeUpCamera:
    return make_camera(tmp_path_factory.mktemp("camera"))
