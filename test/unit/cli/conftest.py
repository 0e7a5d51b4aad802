from __future__ import annotations

import pytest
from camera_files import CameraFiles, write_camera


@pytest.fixture(scope="session")
def camera(tmp_path_factory: pytest.TempPathFactory) -> CameraFiles:
    return write_camera(tmp_path_factory.mktemp("pole_7"))
