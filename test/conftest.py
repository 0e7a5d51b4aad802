"""Fixtures for tests of every kind."""

import pytest
from made_up_camera import MadeUpCamera, make_camera


@pytest.fixture(scope="session")
def camera(tmp_path_factory: pytest.TempPathFactory) -> MadeUpCamera:
    return make_camera(tmp_path_factory.mktemp("camera"))
