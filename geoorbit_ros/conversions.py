"""Messages from arrays and back: the only module that knows both.

What is big or frequent becomes serialised CDR at once (raw publishers take bytes), because a
message of a thousand poses costs rclpy tens of milliseconds to fill and serialise.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Point32,
    PolygonStamped,
    PoseWithCovarianceStamped,
    Quaternion,
)
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import (
    ColorRGBA,
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
)
from visualization_msgs.msg import Marker, MarkerArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.bounded_json import MAX_TEXT
from geoorbit_ros.core.cdr import ENCAPSULATION, SECOND_NS, CdrReader, CdrWriter, with_stamp
from geoorbit_ros.core.errors import CalibrationError, MessageError
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table

__all__ = [
    "datum_from_fix",
    "datum_to_fix",
    "decode_byte_array",
    "decode_path",
    "decode_string",
    "decode_table",
    "encode_byte_array",
    "encode_clock",
    "encode_compressed_image",
    "encode_jpeg",
    "encode_path",
    "encode_pose_array",
    "encode_string",
    "encode_table",
    "findings_array",
    "health_array",
    "lane_markers",
    "lane_poses",
    "message_class",
    "movement_message",
    "movement_of",
    "path_headings",
    "pixel_polygon",
    "time_from_ns",
    "vehicle_poses",
]

_POSE = np.dtype([("position", "<f8", 3), ("orientation", "<f8", 4)])
"""geometry_msgs/Pose: x y z, then the quaternion x y z w."""
_PLACE = struct.Struct("<2d40x")
"""The same when only x and y are wanted."""
_OWN_HEADER = struct.Struct("<8xI")
"""Stamp and length of the frame that each pose of a path has again."""
_DIMENSION = struct.Struct("<II")
"""Size and stride of std_msgs/MultiArrayDimension, after its label."""


DASH_M, DASH_PERIOD_M = 3.0, 9.0
"""Dashes as markers show them: 3 m of 9 m, a usual lane line."""
JPEG_FORMAT, PNG_FORMAT = "bgr8; jpeg compressed bgr8", "bgr8; png compressed bgr8"
"""As compressed_image_transport writes them."""
PLANE_LABEL = (
    "image width and height, matrix (3x3), lens (fx fy cx cy k1 k2 p1 p2 k3, 1 for a known focal "
    "length; zeros for none), K times: spread (3x3) and its k1"
)
"""What the numbers of a road plane are, in their order (`calibration.plane.RoadPlane`)."""
_PLANE_HEAD, _PLANE_ROW = 2 + 9 + 10, 10
"""Numbers before the spread, and in each row of it."""


def message_class(message_type: str) -> type | None:
    """The class of `package/msg/Name`; None for another name or a package not installed."""
    package, _, name = message_type.partition("/msg/")
    if not name:
        return None
    try:
        found: type | None = getattr(import_module(f"{package}.msg"), name, None)
    except ModuleNotFoundError:
        return None
    return found


def time_from_ns(stamp_ns: int) -> Time:
    """`builtin_interfaces/Time` of nanoseconds."""
    second, nanosecond = divmod(stamp_ns, SECOND_NS)
    return Time(sec=second, nanosec=nanosecond)


def encode_clock(stamp_ns: int) -> bytes:
    """`rosgraph_msgs/Clock`, serialised."""
    return with_stamp(ENCAPSULATION, stamp_ns)


def encode_string(text: str) -> bytes:
    """`std_msgs/String`, serialised."""
    writer = CdrWriter()
    writer.text(text)
    return writer.message()


def decode_string(cdr: bytes, place: str) -> str:
    """The text in a serialised `std_msgs/String`.

    Raises:
        MessageError: Bytes that are none, or more than any text has.
    """
    if len(cdr) > MAX_TEXT:
        raise MessageError(place, f"{len(cdr)} bytes", f"a text of {MAX_TEXT} bytes at most")
    return CdrReader(cdr, place, "a std_msgs/String").text()


def encode_byte_array(data: bytes) -> bytes:
    """`std_msgs/ByteMultiArray` without a layout, serialised."""
    writer = CdrWriter()
    writer.raw(bytes(8))  # no dimensions, offset 0
    writer.data(data)
    return writer.message()


def decode_byte_array(cdr: bytes, place: str) -> bytes:
    """The data of a serialised `std_msgs/ByteMultiArray`, whatever layout it names.

    Raises:
        MessageError: Bytes that are none.
    """
    reader = CdrReader(cdr, place, "a std_msgs/ByteMultiArray")
    for _ in range(reader.whole("I")):
        reader.data()  # label
        reader.unpack(_DIMENSION)
    reader.number("I")  # offset
    data = bytes(reader.data())
    if reader.left >= 4:  # some writers pad to four bytes
        reader.end()
    return data


def encode_compressed_image(stamp_ns: int, frame_id: str, kind: str, data: bytes) -> bytes:
    """`sensor_msgs/CompressedImage`, serialised.

    Args:
        stamp_ns: Capture time.
        frame_id: Optical frame of the camera.
        kind: The message's `format`, such as `bgr8; jpeg compressed bgr8`.
        data: The compressed image.
    """
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.text(kind)
    writer.number("I", len(data))
    return writer.message(data)


def encode_jpeg(stamp_ns: int, frame_id: str, image: NDArray[np.uint8], quality: int) -> bytes:
    """An image as JPEG in a serialised `sensor_msgs/CompressedImage`.

    Args:
        stamp_ns: Capture time.
        frame_id: Optical frame of the camera.
        image: (H, W, 3) uint8, blue-green-red.
        quality: Of the JPEG, 1 to 100.
    """
    # OpenCV encodes without holding Python's lock: other threads of the process go on.
    data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
    return encode_compressed_image(stamp_ns, frame_id, JPEG_FORMAT, data)


def encode_png(stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> bytes:
    """An image (H, W, 3), blue-green-red, without loss as a `sensor_msgs/CompressedImage`."""
    data = cv2.imencode(".png", image)[1].tobytes()
    return encode_compressed_image(stamp_ns, frame_id, PNG_FORMAT, data)


def plane_message(plane: RoadPlane, image_size: tuple[int, int]) -> Float64MultiArray:
    """A camera's road plane as numbers; see `PLANE_LABEL`."""
    lens = np.zeros(10)
    if plane.lens is not None:
        lens = np.array([*plane.lens.numbers, float(plane.lens.focal_known)])
    by_k1 = np.zeros(len(plane.spread)) if plane.k1_spread is None else plane.k1_spread
    spread = np.column_stack((plane.spread.reshape(-1, 9), by_k1))
    numbers = np.concatenate([np.array(image_size), plane.matrix.ravel(), lens, spread.ravel()])
    dimension = MultiArrayDimension(label=PLANE_LABEL, size=len(numbers), stride=len(numbers))
    layout = MultiArrayLayout(dim=[dimension], data_offset=0)
    return Float64MultiArray(layout=layout, data=numbers.tolist())


def plane_of(message: Float64MultiArray, place: str) -> tuple[RoadPlane, tuple[int, int]]:
    """The road plane and the size of the camera's images.

    Raises:
        MessageError: Numbers that are none.
    """
    numbers = np.array(message.data, dtype=np.float64)
    rows, odd = divmod(len(numbers) - _PLANE_HEAD, _PLANE_ROW)
    if rows < 0 or odd or not np.isfinite(numbers).all():
        found = f"{len(numbers)} numbers" + (", some not finite" if len(numbers) else "")
        raise MessageError(place, found, f"{_PLANE_HEAD} + K x {_PLANE_ROW} numbers: {PLANE_LABEL}")
    width, height = (int(value) for value in numbers[:2])
    if not (16 <= width <= 32768 and 16 <= height <= 32768):
        raise MessageError(place, f"an image of {width}x{height}", "16 to 32768 pixels a side")
    size, spread = (width, height), numbers[_PLANE_HEAD:].reshape(rows, _PLANE_ROW)
    lens, by_k1 = None, spread[:, 9]
    if numbers[11]:
        fx, fy, cx, cy, k1, k2, p1, p2, k3, known = numbers[11:_PLANE_HEAD].tolist()
        try:
            lens = Lens(fx, fy, cx, cy, size, k1, k2, p1, p2, k3, known > 0.0)
        except CalibrationError as error:
            raise MessageError(f"{place}, {error.place}", error.found, error.expected) from None
    plane = RoadPlane(
        numbers[2:11].reshape(3, 3),
        spread[:, :9].reshape(rows, 3, 3),
        lens=lens,
        k1_spread=by_k1 if by_k1.any() else None,
    )
    return plane, size


def encode_pose_array(
    stamp_ns: int, frame_id: str, xy_m: ArrayLike, heading_rad: ArrayLike
) -> bytes:
    """`geometry_msgs/PoseArray`, serialised.

    Args:
        stamp_ns: Capture time.
        frame_id: Frame of the poses.
        xy_m: (N, 2) metres.
        heading_rad: (N,) counter-clockwise from east.
    """
    poses = _poses(xy_m, heading_rad)
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.number("I", len(poses))
    if len(poses):
        writer.align(8)
    return writer.message(poses.tobytes())


def encode_path(stamp_ns: int, frame_id: str, xy_m: ArrayLike, heading_rad: ArrayLike) -> bytes:
    """`nav_msgs/Path` with the same header in every pose, serialised; arguments as above."""
    poses = _poses(xy_m, heading_rad)
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.number("I", len(poses))
    if len(poses):
        writer.header(stamp_ns, frame_id)  # the first pose starts where the length ends
        writer.align(8)
        writer.raw(poses[:1].tobytes())
        header = CdrWriter()
        header.header(stamp_ns, frame_id)
        header.align(8)  # all others start on a multiple of eight
        each = header.fields()
        rest = np.empty(len(poses) - 1, dtype=[("header", f"V{len(each)}"), ("pose", _POSE)])
        rest["header"] = np.void(each)
        rest["pose"] = poses[1:]
        writer.raw(rest.tobytes())
    return writer.message()


def decode_path(cdr: bytes, place: str) -> tuple[str, NDArray[np.float64]]:
    """Frame and (N, 2) positions in metres of a serialised `nav_msgs/Path`.

    Raises:
        MessageError: Bytes that are none, or positions that are not finite.
    """
    reader = CdrReader(cdr, place, "a nav_msgs/Path")
    _, frame_id = reader.header()
    number = reader.whole("I")
    xy_m = np.empty((min(number, reader.left // _POSE.itemsize), 2))
    for k in range(number):
        reader.skip(reader.unpack(_OWN_HEADER)[0])
        xy_m[k] = reader.unpack(_PLACE, 8)
    if not np.isfinite(xy_m).all():
        raise MessageError(place, "a position that is not finite", "a nav_msgs/Path of metres")
    return frame_id, xy_m


def path_headings(xy_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) direction of travel at each point of a line (K, 2), K >= 2, from its neighbours."""
    step = np.gradient(xy_m, axis=0)
    return np.arctan2(step[:, 1], step[:, 0])


def lane_poses(lanes: Iterable[Lane]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middle (N, 2) and heading (N,) of each lane, for `encode_pose_array`."""
    middles = np.array([lane.middle for lane in lanes]).reshape(-1, 3)
    return middles[:, :2], middles[:, 2]


def vehicle_poses(rows: NDArray[np.void]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Position (N, 2) and heading (N,) of `TRACK_DTYPE` rows; 0 until a vehicle has moved."""
    xy = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    return xy, np.nan_to_num(rows["heading"].astype(np.float64))


def datum_to_fix(datum: Datum, frame_id: str) -> NavSatFix:
    """The map frame's origin; its height is not known."""
    fix = NavSatFix(
        latitude=datum.latitude_deg,
        longitude=datum.longitude_deg,
        altitude=float("nan"),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_UNKNOWN,
    )
    fix.header.frame_id = frame_id
    fix.status.status = NavSatStatus.STATUS_FIX
    return fix


def datum_from_fix(fix: NavSatFix, place: str) -> Datum:
    """The map frame's origin, the same float64 numbers that went into the message.

    Raises:
        MessageError: No latitude and longitude in degrees.
    """
    if not (abs(fix.latitude) <= 90.0 and abs(fix.longitude) <= 180.0):
        found = f"latitude {fix.latitude}, longitude {fix.longitude}"
        raise MessageError(place, found, "degrees from -90 to 90 and -180 to 180")
    return Datum(fix.latitude, fix.longitude)


def health_array(
    stamp_ns: int, name: str, faults: list[str], values: Mapping[str, float | int]
) -> DiagnosticArray:
    """Figures as one status, WARN with the faults as its message."""
    status = DiagnosticStatus(
        level=DiagnosticStatus.WARN if faults else DiagnosticStatus.OK,
        name=name,
        message="; ".join(faults) or "ok",
        values=[
            KeyValue(key=key, value=str(value) if isinstance(value, int) else f"{value:.6g}")
            for key, value in values.items()
        ],
    )
    return DiagnosticArray(header=Header(stamp=time_from_ns(stamp_ns)), status=[status])


def findings_array(
    stamp_ns: int, statuses: Iterable[tuple[str, Sequence[str], Mapping[str, str]]]
) -> DiagnosticArray:
    """One status for each (name, findings, values): WARN with the findings, numbered, as values."""
    found = DiagnosticArray(header=Header(stamp=time_from_ns(stamp_ns)))
    for name, findings, values in statuses:
        numbered = {f"finding_{k}": text for k, text in enumerate(findings, 1)}
        count = f"{len(findings)} finding{'s' if len(findings) != 1 else ''}"
        found.status.append(
            DiagnosticStatus(
                level=DiagnosticStatus.WARN if findings else DiagnosticStatus.OK,
                name=name,
                message=f"{count}: {findings[0]}" if findings else "ok",
                values=[KeyValue(key=k, value=v) for k, v in {**values, **numbered}.items()],
            )
        )
    return found


def movement_message(
    frame_id: str, x_m: float, y_m: float, turn_rad: float, covariance: NDArray[np.float64]
) -> PoseWithCovarianceStamped:
    """A movement in the plane as the pose of what it moves; its stamp is zero.

    Args:
        frame_id: Frame that is moved, about its origin.
        x_m: Translation east.
        y_m: Translation north.
        turn_rad: Rotation, counter-clockwise.
        covariance: (3, 3) of x, y and turn.
    """
    message = PoseWithCovarianceStamped(header=Header(frame_id=frame_id))
    pose = message.pose.pose
    pose.position.x, pose.position.y = x_m, y_m
    pose.orientation.z, pose.orientation.w = np.sin(0.5 * turn_rad), np.cos(0.5 * turn_rad)
    full = np.zeros((6, 6))
    full[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    message.pose.covariance = full.ravel()
    return message


def movement_of(
    message: PoseWithCovarianceStamped, place: str
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Translation (2,), turn and covariance (3, 3) of a movement in the plane.

    Raises:
        MessageError: Numbers that are not finite, or a turn about another axis.
    """
    pose = message.pose.pose
    q = pose.orientation
    full = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    values = np.array([pose.position.x, pose.position.y, q.z, q.w])
    if not (np.isfinite(values).all() and np.isfinite(full).all()):
        raise MessageError(place, "a movement that is not finite", "metres and a quaternion")
    if abs(q.x) > 1e-6 or abs(q.y) > 1e-6 or abs(q.z**2 + q.w**2 - 1.0) > 1e-3:
        raise MessageError(place, "a turn out of the plane", "a turn about the vertical")
    turn = 2.0 * float(np.arctan2(q.z, q.w))
    return values[:2], turn, full[np.ix_([0, 1, 5], [0, 1, 5])]


def lane_markers(lane_map: LaneMap, frame_id: str) -> MarkerArray:
    """Lines, an arrow along the direction of travel and a label for every lane.

    The first marker deletes all older ones, so that vanished lanes vanish, also for a late joiner
    who sees this message alone. Confirmed lanes are opaque, tentative ones faint, and so are lanes
    that are held, whose label says it. Boundaries on paint are drawn as it is: dashed (a
    LINE_LIST), yellow.
    """
    header = Header(stamp=time_from_ns(lane_map.stamp_ns), frame_id=frame_id)
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for lane in lane_map.lanes:
        alpha = 1.0 if lane.status == "confirmed" and not lane_map.held else 0.3
        for role, line, edge in (
            ("centerline", lane.centerline_m, None),
            ("left", lane.left_m, lane.left_edge),
            ("right", lane.right_m, lane.right_edge),
        ):
            colour = ColorRGBA(r=1.0, g=1.0, b=1.0, a=alpha)
            if role == "centerline":
                colour = ColorRGBA(r=0.2, g=0.8, b=1.0, a=alpha)
            elif edge is not None and edge.colour == "yellow":
                colour = ColorRGBA(r=1.0, g=0.85, b=0.1, a=alpha)
            dashed = edge is not None and edge.marking == "dashed"
            kind = Marker.LINE_LIST if dashed else Marker.LINE_STRIP
            marker = _marker(header, role, lane.lane_id, kind, colour)
            points = _dashes(line) if dashed else line
            marker.points = [Point(x=x, y=y) for x, y in points.tolist()]
            marker.scale.x = 0.15
            markers.append(marker)
        x, y, heading = lane.middle
        amber = ColorRGBA(r=1.0, g=0.7, b=0.1, a=alpha)
        arrow = _marker(header, "direction", lane.lane_id, Marker.ARROW, amber)
        arrow.pose.position = Point(x=x, y=y)
        arrow.pose.orientation = Quaternion(z=np.sin(heading / 2), w=np.cos(heading / 2))
        arrow.scale.x, arrow.scale.y, arrow.scale.z = 8.0, 0.8, 0.8
        label = _marker(header, "label", lane.lane_id, Marker.TEXT_VIEW_FACING, amber)
        label.pose.position = Point(x=x, y=y, z=2.0)
        label.scale.z = 2.0
        held = ", held" if lane_map.held else ""
        label.text = f"{lane.lane_id} ({lane.width_m:.1f} m{held})"
        markers += [arrow, label]
    return MarkerArray(markers=markers)


def _dashes(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends (2 N, 2) of dashes along a line: drawn ones, not those of the road."""
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    begin = np.arange(0.0, arc[-1], DASH_PERIOD_M)
    ends = np.column_stack([begin, np.minimum(begin + DASH_M, arc[-1])]).ravel()
    return np.column_stack([np.interp(ends, arc, axis) for axis in line.T])


def pixel_polygon(
    stamp_ns: int, frame_id: str, contour: NDArray[np.floating] | None
) -> PolygonStamped:
    """A closed outline (K, 2) in the image: x right, y down in pixels, z = 0; None has no point."""
    message = PolygonStamped(header=Header(stamp=time_from_ns(stamp_ns), frame_id=frame_id))
    points = [] if contour is None else contour.tolist()
    message.polygon.points = [Point32(x=x, y=y) for x, y in points]
    return message


def _marker(header: Header, role: str, lane_id: int, kind: int, colour: ColorRGBA) -> Marker:
    return Marker(header=header, ns=role, id=lane_id, type=kind, action=Marker.ADD, color=colour)


def _poses(xy_m: ArrayLike, heading_rad: ArrayLike) -> NDArray[np.void]:
    """(N,) poses in the plane z = 0."""
    xy = np.asarray(xy_m, dtype=np.float64).reshape(-1, 2)
    half = np.asarray(heading_rad, dtype=np.float64) / 2
    poses = np.zeros(len(xy), dtype=_POSE)
    poses["position"][:, :2] = xy
    poses["orientation"][:, 2] = np.sin(half)
    poses["orientation"][:, 3] = np.cos(half)
    return poses
