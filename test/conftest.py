"""Fixtures for tests of every kind."""

import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from made_up_camera import MadeUpCamera, make_camera

# A shell's background job ignores Ctrl-C, and so would every process the tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run: a red test is the change's doing, not that of chance. No limits of
# time: a busy machine is slow.
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")

UNIT = Path(__file__).parent / "unit"
LONG = [
    "accuracy",
    "bag_command",
    "box_projector",
    "byzantine",
    "camera_pose",
    "crash_points",
    "detect_images",
    "detector_model",
    "differential_privacy",
    "driven_lanes",
    "driving_side",
    "events",
    "export",
    "extend_guide",
    "faulty_ground_points",
    "fleet_passwords",
    "forecast",
    "frame_source",
    "frame_sources",
    "geolane_corners",
    "lane_access",
    "lane_embedding",
    "lane_rights",
    "lanes_command",
    "left_hand",
    "main",
    "map_build",
    "map_validation",
    "motion",
    "odd_bags",
    "one_fleet",
    "osm_extract",
    "payload_fuzz",
    "plausibility",
    "plugins",
    "process_scene",
    "projected_blocks",
    "random_scene",
    "real_cameras",
    "render_boxes",
    "render_image",
    "render_scene",
    "scene_output",
    "scene_run",
    "side_by_side",
    "study",
    "supervisor",
    "thrift",
    "track_bag",
    "tracker_laws",
    "tracker_on_recordings",
    "traffic",
    "trajectory_database",
    "turnarounds",
    "twin_commands",
    "twin_map_commands",
    "twin_replay",
    "twin_truth",
    "video_files",
]
"""Files of test/unit, without `test_`, that take seconds: what simulates, renders or trains."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every other unit test as `quick`."""
    long_files = {f"test_{name}" for name in LONG}
    for item in items:
        if UNIT in item.path.parents and item.path.stem not in long_files:
            item.add_marker("quick")


@pytest.fixture(scope="session")
def camera(tmp_path_factory: pytest.TempPathFactory) -> MadeUpCamera:
    return make_camera(tmp_path_factory.mktemp("camera"))
