"""Laws of whole runs: repeatable, true to the lanes, the same wherever the scene points."""

from __future__ import annotations

import numpy as np
import pytest
from made_scenes import Array, rotation_of, run_of, true_lanes, turned

from geoorbit_ros.core.errors import ParameterError, RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.roadnet import netconvert
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import SceneRun, simulate

RUNS = ("straight_3x3", "curve_250m", "on_ramp_merge")


def bits(run: SceneRun) -> list[bytes]:
    frames = [f.stamp_ns.tobytes() + f.rows.tobytes() for f in (run.frames, run.clean)]
    lanes = [lane.centerline_m.tobytes() + bytes(str(lane.vehicles), "ascii") for lane in run.truth]
    return [*frames, *lanes, run.control_points.pixel.tobytes()]


def positions(clean: Frames) -> Array:
    return np.column_stack([clean.rows["x"], clean.rows["y"]]).astype(float)


def beside(lane: Lane, points: Array) -> tuple[Array, Array]:
    """Signed distance (N,) to the left of a lane's centreline, NaN beyond its ends; its heading."""
    a, step = lane.centerline_m[:-1], np.diff(lane.centerline_m, axis=0)
    length = np.hypot(*step.T)
    t = (((points[:, None] - a) * step).sum(axis=2)) / length**2
    gap = points[:, None] - (a + np.clip(t, 0.0, 1.0)[..., None] * step)
    nearest = np.argmin(np.hypot(gap[..., 0], gap[..., 1]), axis=1)
    row = np.arange(len(points))
    unit = step[nearest] / length[nearest, None]
    chosen = gap[row, nearest]
    offset = unit[:, 0] * chosen[:, 1] - unit[:, 1] * chosen[:, 0]
    beyond = ((nearest == 0) & (t[:, 0] < 0.0)) | ((nearest == len(a) - 1) & (t[:, -1] > 1.0))
    return np.where(beyond, np.nan, offset), np.arctan2(unit[:, 1], unit[:, 0])


def same_way_offsets(run: SceneRun) -> Array:
    """(lanes, N) offset of each true point from each lane of its direction, else NaN."""
    heading = run.clean.rows["heading"].astype(float)
    found = []
    for lane in run.truth:
        offset, along = beside(lane, positions(run.clean))
        found.append(np.where(np.cos(heading - along) > 0.7, offset, np.nan))
    return np.array(found)


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not() -> None:
    first = run_of("straight_3x3")
    again = simulate(first.scene, 10.0, 1)
    assert bits(again) == bits(first)
    other = bits(run_of("straight_3x3", seed=2))
    assert all(a != b for a, b in zip(bits(first)[:2], other[:2], strict=True))


@pytest.mark.parametrize("name", RUNS)
def test_frames_come_at_the_cameras_rate(name: str) -> None:
    run = run_of(name)
    fps = run.scene.camera.fps
    assert len(run.frames) == len(run.clean) == int(10.0 * fps)
    assert np.array_equal(run.frames.stamp_ns, run.clean.stamp_ns)
    gaps = np.diff(run.frames.stamp_ns) / 1e9
    assert gaps.mean() == pytest.approx(1.0 / fps, rel=0.01)
    assert np.all((gaps > 0.3 / fps) & (gaps < 2.0 / fps))


@pytest.mark.parametrize("name", RUNS)
def test_the_truth_is_where_vehicles_drive(name: str) -> None:
    run = run_of(name, faultless=True)
    offsets = np.abs(same_way_offsets(run))
    heading = run.clean.rows["heading"].astype(float)
    same_way = np.array([np.cos(heading - lane.middle[2]) > 0.5 for lane in run.truth])
    # Lanes are seen over different lengths: count vehicles where all lanes of their way are.
    counted = (np.isfinite(offsets) == same_way).all(axis=0) & same_way.any(axis=0)
    nearest = np.nanmin(offsets[:, counted], axis=0)
    assert counted.sum() > 200
    # Between two lanes is where lane changers are; no vehicle is on the verge.
    assert np.all(nearest < 0.5 * run.scene.lane_width_m + 0.6)
    # Habit and wander: 0.2 and 0.12 m.
    assert np.median(nearest) < 0.3
    assert np.mean(nearest < 0.8) > 0.7  # spread evenly over the road it would be 0.44


def test_vehicles_keep_their_speed_and_heading() -> None:
    run = run_of("straight_3x3", faultless=True)
    rows, time_s = run.clean.rows, run.clean.row_stamp_ns() / 1e9
    for vehicle in np.unique(rows["track_id"]):
        own = rows["track_id"] == vehicle
        if own.sum() < 10:
            continue
        xy, t = positions(run.clean)[own], time_s[own]
        velocity = np.diff(xy, axis=0) / np.diff(t)[:, None]
        told = np.column_stack([rows["vx"][own], rows["vy"][own]])[:-1]
        # Each step of the wander changes the lateral speed by about 0.3 m/s.
        assert np.all(np.hypot(*(velocity - told).T) < 2.0)
        speed = np.hypot(*velocity.T)
        assert np.all((speed > 10.0) & (speed < 45.0))
        moving = np.arctan2(velocity[:, 1], velocity[:, 0])
        assert np.all(np.cos(moving - rows["heading"][own][:-1]) > 0.99)


def test_without_faults_every_box_stands_on_its_vehicles_footprint() -> None:
    run = run_of("curve_250m", faultless=True)
    rows, clean = run.frames.rows, run.clean.rows
    assert len(rows) == len(clean) > 200
    assert np.array_equal(run.frames.offset, run.clean.offset)
    along = np.column_stack([np.cos(clean["heading"]), np.sin(clean["heading"])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    size = np.array(run.image_size)
    for a in (-0.5, 0.5):
        for b in (-0.5, 0.5):
            corner = (
                positions(run.clean)
                + a * clean["length"][:, None] * along
                + b * clean["width"][:, None] * across
            )
            pixel, _ = run.camera.project(np.pad(corner, ((0, 0), (0, 1))))
            for k, (middle, extent) in enumerate((("x", "width"), ("y", "height"))):
                clipped = np.clip(pixel[:, k], 0.0, size[k])
                low = rows[middle] - rows[extent] / 2
                high = rows[middle] + rows[extent] / 2
                assert np.all((clipped > low - 0.02) & (clipped < high + 0.02))
    pairs = np.unique(np.column_stack([rows["track_id"], clean["track_id"]]), axis=0)
    assert len(pairs) == len(np.unique(rows["track_id"]))  # no id has two vehicles


@pytest.mark.parametrize("name", RUNS)
def test_a_lane_counts_the_vehicles_that_drove_along_it(name: str) -> None:
    run = run_of(name, faultless=True)
    vehicle = run.clean.rows["track_id"]
    for lane, offset in zip(run.truth, np.abs(same_way_offsets(run)), strict=True):
        inside = offset < 0.5 * lane.width_m
        count = 0
        for number in np.unique(vehicle[inside]):
            path = positions(run.clean)[(vehicle == number) & inside]
            count += int(np.hypot(*np.diff(path, axis=0).T).sum() >= 20.0)
        # Vehicles on their way between two lanes may count for either.
        assert abs(run.lane_vehicles[lane.lane_id] - count) <= 1
    assert sum(run.lane_vehicles.values()) > 0


@pytest.mark.parametrize("angle_deg", [90.0, 137.0])
def test_turning_the_world_turns_the_truth(angle_deg: float) -> None:
    scene = load_scene("off_ramp_diverge")
    before, after = true_lanes(scene), true_lanes(turned(scene, angle_deg))
    assert len(before) == len(after) == 4
    for a, b in zip(before, after, strict=True):
        for role in ("centerline_m", "left_m", "right_m"):
            expected = getattr(a, role) @ rotation_of(angle_deg).T
            assert np.allclose(getattr(b, role), expected, atol=1e-6)
        assert (b.heading_deg - a.heading_deg + angle_deg + 180.0) % 360.0 == pytest.approx(180.0)


def test_turning_the_world_turns_the_run() -> None:
    before = run_of("straight_3x3", faultless=True)
    after = simulate(turned(before.scene, 137.0), 10.0, 1)
    assert after.lane_vehicles == before.lane_vehicles
    assert np.array_equal(after.clean.rows["track_id"], before.clean.rows["track_id"])
    moved = positions(before.clean) @ rotation_of(137.0).T
    # SUMO's own geometry is rounded to centimetres.
    assert np.all(np.hypot(*(positions(after.clean) - moved).T) < 0.05)
    # The image does not turn.
    assert np.allclose(after.frames.rows["x"], before.frames.rows["x"], atol=1.0)
    assert np.allclose(after.control_points.pixel, before.control_points.pixel, atol=1e-6)


def test_control_points_are_surveyed_to_centimetres_and_clicked_to_half_pixels() -> None:
    run = run_of("straight_3x3")
    points = run.control_points
    assert len(points) >= 10
    pixel, _ = run.camera.project(np.pad(points.local_m, ((0, 0), (0, 1))))
    error = np.hypot(*(pixel - points.pixel).T)
    assert 0.05 < error.mean() < 4.0
    assert np.all(np.ptp(points.pixel, axis=0) > 0.2 * np.array(run.image_size))


def test_boxes_are_missing_and_ids_change_with_faults() -> None:
    ideal, real = run_of("straight_3x3", faultless=True), run_of("straight_3x3")
    assert len(real.clean.rows) < len(ideal.clean.rows)
    false = len(real.frames.rows) - len(real.clean.rows)
    assert false == len(real.frames) * real.scene.detector.false_tracks


def test_progress_goes_from_nothing_to_all() -> None:
    told: dict[str, list[float]] = {"traffic": [], "camera": []}
    simulate(load_scene("s_curve"), 5.0, 1, lambda step, share: told[step].append(share))
    for shares in told.values():
        assert shares[0] == 0.0
        assert shares[-1] == 1.0
        assert shares == sorted(shares)


@pytest.mark.parametrize("duration", [0.0, -5.0, float("nan"), float("inf"), 1e6])
def test_a_duration_out_of_range_is_refused(duration: float) -> None:
    with pytest.raises(ParameterError, match=r"duration: found .* expected 1 to 21600 s"):
        simulate(load_scene("s_curve"), duration, 1)


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(ParameterError, match="seed: found"):
        simulate(load_scene("s_curve"), 5.0, seed)


def test_a_missing_sumo_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(netconvert, "find_spec", lambda _name: None)
    with pytest.raises(RoadNetworkError, match=r"SUMO: found no Python package.*pip install"):
        simulate(load_scene("s_curve"), 5.0, 1)


def test_a_missing_netconvert_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda _name: None)
    with pytest.raises(RoadNetworkError, match="no program 'netconvert'"):
        simulate(load_scene("s_curve"), 5.0, 1)


def test_traffic_flows_from_the_first_frame_on() -> None:
    run = run_of("straight_3x3", faultless=True)
    counts = np.diff(run.clean.offset)
    assert counts[:15].mean() > 0.5 * counts.mean()
