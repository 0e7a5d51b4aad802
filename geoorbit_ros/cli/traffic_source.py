"""Where `geoorbit traffic` has tracks and lanes from: a camera's files, or a database."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from geoorbit_ros.cli.inputs import make_mapper
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.calibration.plane import RoadPlane
    from geoorbit_ros.cli.camera_input import CameraInput
    from geoorbit_ros.core.frame_spool import AnyFrames
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.lanes.geojson import LaneFile
    from geoorbit_ros.traffic.count import BlockSource, Recorded
    from geoorbit_ros.traffic.interval_clock import IntervalClock
    from geoorbit_ros.traffic.lane_maps import LanesAt, StampedLanes
    from geoorbit_ros.traffic.stations import StationPlace


@dataclass(frozen=True)
class TrafficSource:
    """Ground tracks of one camera and the lanes that they are counted on.

    Attributes:
        camera_id: Its name.
        lane_map: The lanes.
        write_lanes: Writes those that were counted on last to a file.
        datum: Origin of the map frame of both.
        plane: The calibration, if it is known.
        blocks: The ground tracks.
        frames_between: Those from one stamp to another, both included.
        frame_count: How many frames there are.
        max_gap_s: How long a pause between frames may be.
        reports: What is to be said about the input.
        files: Names and values for the report: where tracks and lanes came from.
        first_ns: Stamp of the first frame, where the lanes may change over time.
        lanes_at: The map of the time; None: `lane_map` counts for all of it.
        beside: The ground tracks for a second process; None: there are too few for one.
    """

    camera_id: str
    lane_map: LaneMap
    write_lanes: Callable[[Path, Recorded], None]
    datum: Datum
    plane: RoadPlane | None
    blocks: Callable[[], Iterator[Frames]]
    frames_between: Callable[[int, int], Frames]
    frame_count: int
    max_gap_s: float
    reports: Callable[[], tuple[InputReport, ...]]
    files: tuple[tuple[str, str], ...] = ()
    first_ns: int = 0
    lanes_at: LanesAt | None = None
    beside: BlockSource | None = None

    def count(
        self, clock: IntervalClock | None = None, place: StationPlace | None = None
    ) -> Recorded:
        """Count all vehicles, under a progress bar.

        Args:
            clock: Intervals, each of which is counted on the map of its time; None: `lane_map`
                counts for all.
            place: Where counting stations are to be; None: where traffic is seen best.
        """
        from geoorbit_ros.cli.console import shown_progress
        from geoorbit_ros.traffic.count import record
        from geoorbit_ros.traffic.counter import TrafficCounter
        from geoorbit_ros.traffic.lane_maps import MapChoice, MapInUse
        from geoorbit_ros.traffic.stations import measured_lanes

        counter, choice, first = TrafficCounter(self.lane_map.lanes, self.plane, place), None, None
        if clock is not None and self.lanes_at is not None:
            begin_ns = clock.start_of(self.first_ns)
            choice = MapChoice(clock, self.lanes_at)
            found = choice.start(begin_ns)
            if found is None:  # no map has a confirmed lane: the last one counts as it is
                choice = None
            else:
                counter = TrafficCounter(found.lanes, self.plane, place)
                order = measured_lanes(counter.lanes, counter.stations)
                first = MapInUse(begin_ns, found.stamp_ns, counter.lanes, order)
        with shown_progress() as tell:

            def told() -> Iterator[Frames]:
                done = 0
                for frames in self.blocks():
                    yield frames
                    done += len(frames)
                    tell("counting vehicles", min(done / max(self.frame_count, 1), 1.0))

            return record(counter, told(), self.max_gap_s, choice, first, self.beside)


def source_of_camera(
    camera: CameraInput,
    lanes: Path | None,
    estimator: str,
    update_period_s: float,
    image: str | None,
) -> TrafficSource:
    """The traffic of a file of tracks or a bag."""
    from geoorbit_ros.cli.console import read_lanes_aloud
    from geoorbit_ros.core.frame_spool import FrameSpool
    from geoorbit_ros.core.tables import join_blocks
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.traffic.count import BLOCK_ROWS
    from geoorbit_ros.traffic.interval_clock import usual_gap_s

    kept: AnyFrames
    if camera.helper is not None:
        kept, ground = camera.helper.ground, camera.ground_tracks()
    else:
        kept = join_blocks(list(camera.ground_tracks()))
        ground = iter([kept])
    if lanes:
        lane_map = read_lanes_aloud(lanes, camera.datum).lane_map
        deque(ground, maxlen=0)
    else:
        lane_map = camera.find_lanes(ground, make_mapper(estimator, update_period_s))
    if image and not lanes:
        lane_map, _ = camera.follow_paint(lane_map, image)

    def write(path: Path, _: Recorded) -> None:
        write_lanes(path, lane_map, camera.datum, camera_id=camera.camera_id, estimator=estimator)

    return TrafficSource(
        camera.camera_id,
        lane_map,
        write,
        camera.datum,
        camera.homography,
        lambda: kept.blocks(BLOCK_ROWS),
        kept.between,
        len(camera.boxes),
        usual_gap_s(camera.boxes),
        camera.reports,
        (
            ("Tracks", camera.source.name),
            ("Control points", camera.calibration.name),
            ("Lanes", lanes.name if lanes else estimator),
        ),
        beside=kept if isinstance(kept, FrameSpool) else None,
    )


def source_of_database(
    database: Path, camera_id: str | None, calibration: Path | None, lanes: Path | None
) -> TrafficSource:
    """The traffic of one camera in a trajectory database.

    Raises:
        GeoOrbitError: No such camera, several and none named, or no lanes.
    """
    from geoorbit_ros.cli.console import read_lanes_aloud
    from geoorbit_ros.cli.inputs import read_plane
    from geoorbit_ros.core.frame_spool import SPOOLED_ROWS
    from geoorbit_ros.lanes.geojson import parse_lane_file, write_lanes
    from geoorbit_ros.storage.database.reader import TrajectoryReader
    from geoorbit_ros.traffic.count import BLOCK_ROWS
    from geoorbit_ros.traffic.interval_clock import GAP_S

    with TrajectoryReader(database) as reader:
        cameras = {camera.camera_id: camera for camera in reader.cameras()}
        name = camera_id or _only_camera(database, list(cameras))
        stamps = reader.lane_map_stamps(name)
        if not stamps and lanes is None:
            raise ParameterError("option --lanes", f"no lane map of {name} stored", "a lane file")
        text = reader.lane_maps(name, stamps[-1], stamps[-1] + 1)[0][1] if stamps else ""
    stored = parse_lane_file(text, f"{database}, lane map of {name}") if stamps else None
    file = read_lanes_aloud(lanes, stored.datum if stored else None) if lanes else stored
    assert file is not None
    plane = read_plane(calibration, file.datum) if calibration else None

    tracks = DatabaseTracks(database, name)

    def frames_between(first_ns: int, last_ns: int) -> Frames:
        with TrajectoryReader(database) as reader:
            return reader.read(name, first_ns, last_ns + 1)

    over_time = StoredMaps(database, name) if lanes is None and stored is not None else None

    def write(path: Path, recorded: Recorded) -> None:
        used = file
        if over_time is not None and recorded.maps:
            used = over_time.files[recorded.maps[-1].map_ns]
        write_lanes(path, used.lane_map, used.datum, camera_id=name, estimator=used.estimator)

    files = (("Tracks", database.name), ("Lanes", lanes.name if lanes else database.name))
    return TrafficSource(
        name,
        file.lane_map,
        write,
        file.datum,
        plane,
        lambda: tracks.blocks(BLOCK_ROWS),
        frames_between,
        cameras[name].frames if name in cameras else 0,
        GAP_S,
        lambda: (),
        files,
        cameras[name].start_ns if name in cameras else 0,
        None if over_time is None else over_time.lanes_at,
        tracks if name in cameras and cameras[name].rows > SPOOLED_ROWS else None,
    )


@dataclass(frozen=True, slots=True)
class DatabaseTracks:
    """The ground tracks of a camera in a trajectory database.

    Attributes:
        database: The recorder's file.
        camera_id: Whose.
    """

    database: Path
    camera_id: str

    def blocks(self, rows: int) -> Iterator[Frames]:
        """All frames, about so many rows together."""
        from geoorbit_ros.core.tables import Frames, join_blocks
        from geoorbit_ros.storage.database.reader import TrajectoryReader

        with TrajectoryReader(self.database) as reader:
            waiting, count = list[Frames](), 0
            for batch in reader.batches(self.camera_id):
                waiting.append(batch)
                count += len(batch.rows)
                if count >= rows:
                    yield join_blocks(waiting)
                    waiting, count = [], 0
            if waiting:
                yield join_blocks(waiting)


def _only_camera(database: Path, known: list[str]) -> str:
    """The camera of a database that has one.

    Raises:
        ParameterError: There is none, or there are several.
    """
    if not known:
        raise ParameterError("option --database", f"no camera in {database}", "tracks in it")
    if len(known) > 1:
        found = f"{len(known)} cameras in {database}"
        raise ParameterError("option --camera-id", found, f"one of {', '.join(known)}")
    return known[0]


class StoredMaps:
    """The lane maps that are stored of a camera; those with a confirmed lane count.

    Args:
        database: The recorder's file.
        camera_id: Whose.

    Attributes:
        files: Those that were looked at, by stamp.
        first: Stamp of the first that counts; None: none does.
    """

    def __init__(self, database: Path, camera_id: str) -> None:
        from geoorbit_ros.storage.database.traffic import TrafficReader

        self._database, self._camera = database, camera_id
        self._started = False
        self.files: dict[int, LaneFile] = {}
        with TrafficReader(database) as reader:
            self._stamps = reader.lane_map_stamps(camera_id)
        self.first = next((s for s in self._stamps if self._lanes(s) is not None), None)

    def lanes_at(self, at_ns: int) -> StampedLanes | None:
        """See `traffic.lane_maps.LanesAt`; as `TrafficFollower` has them."""
        earlier = [stamp for stamp in self._stamps if stamp <= at_ns]
        found = self._lanes(earlier[-1]) if earlier else None
        if found is None and self.first is not None and not self._started:
            found = self._lanes(self.first)
        self._started = True
        return found

    def _lanes(self, stamp_ns: int) -> StampedLanes | None:
        """The lanes of a map; None where none is confirmed."""
        from geoorbit_ros.lanes.geojson import parse_lane_file
        from geoorbit_ros.storage.database.reader import TrajectoryReader
        from geoorbit_ros.traffic.lane_maps import StampedLanes

        if stamp_ns not in self.files:
            place = f"{self._database}, lane map of {self._camera}"
            with TrajectoryReader(self._database) as reader:
                ((_, text),) = reader.lane_maps(self._camera, stamp_ns, stamp_ns + 1)
            self.files[stamp_ns] = parse_lane_file(text, place)
        found = StampedLanes(stamp_ns, self.files[stamp_ns].lane_map.lanes)
        return found if found.counts else None
