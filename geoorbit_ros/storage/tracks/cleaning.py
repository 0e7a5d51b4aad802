"""From the rows of a file to frames of tracked boxes: the one policy for all formats.

What one row says is repaired, used or left out, counted, and told with the first example.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.storage.tracks.classes import OTHER_CLASS, class_number
from geoorbit_ros.storage.tracks.csv_text import as_numbers
from geoorbit_ros.storage.tracks.raw_tracks import Array, RawTracks

MAX_FPS = 1000.0
"""Chosen: cameras on roads are far slower; a larger number is a typing error."""
NO_ID = -1
"""What trackers write for a box that belongs to no track."""
NO_ID_WORDS = ("", "nan", "none", "null", "na", "n/a", "<na>")
"""What else programs write for it, in small letters."""
NORMALISED = 1.5
"""Boxes whose numbers are all below this are shares of the image, not pixels: the smallest image
that has room for a vehicle is a hundred times as wide."""
_PERCENT = 100.0
"""The largest score of detectors that count in percent."""
CONTRADICTION_SHARE = 0.1
"""Where more frames than this share have an earlier time than the frame before, numbers and times
say different things. Chosen: a clock that is set while a camera records goes back once or twice."""
OUTSIDE_SHARE = 0.05
"""More boxes than this wholly outside of the image are no accident: it has another size. Chosen:
trackers that predict vehicles on their way out make a few; larger overlooks a wrong size."""
ODD_SCORES = 0.05
"""So few scores outside of 0 to 1 are faults of rows, more are another scale."""
_INT32 = np.iinfo(np.int32)
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a user may say about a file of tracks.

    Attributes:
        image_size: (width, height) of the image in pixels.
        fps: Images per second, for formats without times.
        classes: Names of the file's class numbers (`classes.class_table`).
        columns: Names of columns by what they mean.
        strict: Whether any fault refuses the file.
        default_size: Taken where neither the user nor the file says how large the image is.
    """

    image_size: tuple[int, int] | None = None
    fps: float | None = None
    classes: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    strict: bool = False
    default_size: tuple[int, int] | None = None

    def size(self, said: tuple[int, int] | None, report: InputReport) -> tuple[int, int] | None:
        """The image's size; what speaks against the user's is noted.

        Args:
            said: What the file says.
            report: Of the file; it keeps the size.
        """
        if self.image_size and said and said != self.image_size:
            used, other = ("{}x{}".format(*pixels) for pixels in (self.image_size, said))
            text = f"the image is {used} as you say, but {other} as the file says; yours is used"
            report.note(Treatment.NOTED, text)
        report.image_size = self.image_size or said or self.default_size
        return report.image_size


FAR_TWINS, FAR_TWINS_SHARE = 0.1, 0.03
"""Boxes of one id in one frame that lie a tenth of all places' spread apart are two vehicles; where
more than 3 % of the boxes are such, the ids are not those of one recording. Chosen: a tracker that
writes rows twice puts them on one place."""
FAR_SPANS, FAR_S, FAR_SHARE = 10.0, 60.0, 0.01
"""A time ten recordings and a minute away from the middle 90 % is wrong where at most 1 % of the
rows have such times. Chosen: a recording with a pause overnight has far more on both sides."""


def clean_tracks(raw: RawTracks, options: ReadOptions, expected: str) -> tuple[Frames, InputReport]:
    """Frames of `PIXEL_TRACK_DTYPE` in time order, and what was done with the rows.

    Args:
        raw: The rows of the file.
        options: What the user says.
        expected: What the file should be, for errors.

    Raises:
        InputFileError: Nothing sensible can be made of the file.
        ParameterError: A frame rate outside (0, 1000].
    """
    report = raw.report
    if not len(raw):
        raise InputFileError(report.place, "no boxes", expected)
    size = options.size(raw.image_size, report)
    _scale_shares(raw, size)
    use = _usable(raw, size)
    track_id = _ids(raw, use)
    stamp_ns = _stamps(raw, options, use, expected)
    use &= stamp_ns >= 0
    report.check(options.strict, expected)
    if not use.any():
        raise InputFileError(report.place, "no box that can be used", expected)
    rows = np.zeros(len(raw), PIXEL_TRACK_DTYPE)
    for name, values in (("x", raw.x), ("y", raw.y), ("width", raw.width), ("height", raw.height)):
        rows[name] = np.where(use, values, 0.0)
    rows["score"], rows["class_id"] = _scores(raw, use), _classes(raw, options)
    rows["track_id"] = track_id
    rows["flags"] = np.where(raw.ground_point, FLAG_GROUND_POINT, 0)
    if raw.flags is not None:
        rows["flags"] |= raw.flags
    for name in ("width", "height"):
        rows[name][raw.ground_point] = 0.0
    at = np.flatnonzero(use)
    out_of_order = int(np.count_nonzero(np.diff(stamp_ns[at]) < 0))
    if out_of_order:
        k = int(at[np.argmax(np.diff(stamp_ns[at]) < 0) + 1])
        text = "not in the order of time; they are sorted"
        report.add(Treatment.REPAIRED, out_of_order, text, raw.place(k))
    at = at[np.argsort(stamp_ns[at], kind="stable")]
    at = _without_twins(raw, rows, stamp_ns, at)
    report.check(options.strict, expected)
    stamps, start = np.unique(stamp_ns[at], return_index=True)
    return Frames(stamps, np.append(start, len(at)).astype(np.int64), rows[at]), report


def _leave_out(raw: RawTracks, use: Mask, good: Mask, text: str) -> None:
    """Take rows out of `use` that are not `good`."""
    bad = use & ~good
    if bad.any():
        k = int(np.argmax(bad))
        raw.report.add(Treatment.LEFT_OUT, int(bad.sum()), text, _shown(raw, k))
        use &= good


def _shown(raw: RawTracks, k: int) -> str:
    x, y, width, height = raw.x[k], raw.y[k], raw.width[k], raw.height[k]
    return f"{raw.place(k)}: x {x:g}, y {y:g}, w {width:g}, h {height:g}"


def _scale_shares(raw: RawTracks, size: tuple[int, int] | None) -> None:
    """Boxes in shares of the image become pixels."""
    numbers = np.concatenate([raw.x, raw.y, raw.width, raw.height])
    numbers = numbers[np.isfinite(numbers)]
    sized = ~raw.ground_point & (raw.width > 0)
    if not len(numbers) or not sized.any() or np.abs(numbers).max() > NORMALISED:
        return
    if size is None:
        found = "boxes in shares of the image (0 to 1)"
        raise InputFileError(raw.report.place, found, "pixels, or --image-size WxH")
    raw.x, raw.width = raw.x * size[0], raw.width * size[0]
    raw.y, raw.height = raw.y * size[1], raw.height * size[1]
    text = f"boxes are shares of the image; they are taken times {size[0]}x{size[1]} pixels"
    raw.report.note(Treatment.REPAIRED, text)


def _usable(raw: RawTracks, size: tuple[int, int] | None) -> Mask:
    """(N,) boxes that say where a vehicle is."""
    use = np.ones(len(raw), dtype=np.bool_)
    finite = np.isfinite(raw.x) & np.isfinite(raw.y) & np.isfinite(raw.width)
    _leave_out(raw, use, finite & np.isfinite(raw.height), "a position or size that is no number")
    turned = use & (raw.width < 0) & (raw.height < 0)
    if turned.any():
        k = int(np.argmax(turned))
        text = "corners exchanged (the second above and left of the first)"
        raw.report.add(Treatment.REPAIRED, int(turned.sum()), text, _shown(raw, k))
        raw.width[turned], raw.height[turned] = -raw.width[turned], -raw.height[turned]
    sized = (raw.width > 0) & (raw.height > 0)
    _leave_out(raw, use, sized | raw.ground_point, "a width or height that is not above 0")
    if size is not None:
        with np.errstate(invalid="ignore"):
            inside = (raw.x + 0.5 * raw.width >= 0) & (raw.x - 0.5 * raw.width <= size[0])
            inside &= (raw.y + 0.5 * raw.height >= 0) & (raw.y - 0.5 * raw.height <= size[1])
        outside = use & ~inside & ~raw.ground_point
        text = f"wholly outside the image of {size[0]}x{size[1]}"
        _leave_out(raw, use, inside | raw.ground_point, text)
        if outside.sum() > OUTSIDE_SHARE * np.count_nonzero(~raw.ground_point):
            right = np.nanmax(raw.x[outside] + 0.5 * raw.width[outside])
            bottom = np.nanmax(raw.y[outside] + 0.5 * raw.height[outside])
            text = f"the image is {size[0]}x{size[1]}, but boxes reach {right:.0f}x{bottom:.0f}"
            raw.report.note(Treatment.DOUBTFUL, f"{text}: is that its size?")
        beyond = use & raw.ground_point & ~inside
        if beyond.any():
            k = int(np.argmax(beyond))
            text = f"ground points outside the image of {size[0]}x{size[1]}, used all the same"
            raw.report.add(Treatment.NOTED, int(beyond.sum()), text, _shown(raw, k))
    return use


def _readable(raw: RawTracks, frame: Array | None, fps: float | None, use: Mask) -> Stamps | None:
    """The file's times; None where frame numbers and a rate are all that can be read."""
    stamp_ns = raw.stamp_ns
    if stamp_ns is None or frame is None or not fps or (use & (stamp_ns >= 0)).any():
        return stamp_ns
    text = "no time can be read; the frame numbers and the rate count"
    raw.report.note(Treatment.REPAIRED, text + _first_time(raw, use))
    return None


def _first_time(raw: RawTracks, rows: Mask) -> str:
    """The first time of some rows as the file writes it, in brackets."""
    if raw.time_text is None or not rows.any():
        return ""
    return f" ('{raw.time_text[int(np.argmax(rows))].as_py()}')"


def _stamps(raw: RawTracks, options: ReadOptions, use: Mask, expected: str) -> NDArray[np.int64]:
    """(N,) capture time of each row; -1 where it is not known."""
    place = raw.report.place
    frame = raw.frame
    if frame is not None:
        whole = np.isfinite(frame) & (frame == np.rint(frame)) & (np.abs(frame) < 2**53)
        if raw.stamp_ns is None:
            _leave_out(raw, use, whole, "a frame number that is no whole number")
        elif (use & ~whole).any():
            k = int(np.argmax(use & ~whole))
            count = int((use & ~whole).sum())
            text = "a frame number that is no whole number; the time counts"
            raw.report.add(Treatment.REPAIRED, count, text, raw.place(k))
        frame = np.where(whole, frame, np.nan)
    fps = options.fps or raw.fps
    stamp_ns = _readable(raw, frame, fps, use)
    if stamp_ns is not None:
        known = stamp_ns >= 0
        if frame is not None:
            stamp_ns = _agreed(raw, frame, stamp_ns, use & known)
            known = stamp_ns >= 0
        _leave_out(raw, use, known, f"a time that can't be read{_first_time(raw, use & ~known)}")
        _leave_out(raw, use, _near_the_others(stamp_ns, use), "a time far from all others")
        return stamp_ns
    if frame is None:
        raise InputFileError(place, "boxes without a frame number or a time", expected)
    if fps is None:
        found = f"{raw.format_name} without times"
        raise InputFileError(place, found, "--fps: how many images per second the camera took")
    if not 0.0 < fps <= MAX_FPS:
        raise ParameterError("frame rate", f"{fps:g}", f"above 0, up to {MAX_FPS:g} per second")
    if options.fps is None:
        text = f"times follow from {fps:g} images per second, the rate of {raw.format_name}"
        raw.report.note(Treatment.NOTED, f"{text}; --fps gives another")
    first = min(raw.first_frame, int(np.nanmin(frame[use], initial=raw.first_frame)))
    stamps = np.rint((frame - first) * (1e9 / fps))
    return np.where(np.isfinite(stamps), stamps, -1).astype(np.int64)


def _near_the_others(stamp_ns: Stamps, use: Mask) -> Mask:
    """Rows whose time is not far from the recording's: a single wrong one would stretch it."""
    if not use.any():
        return use
    low, high = np.percentile(stamp_ns[use], (5.0, 95.0))
    reach = FAR_SPANS * (high - low) + FAR_S * 1e9
    near = (stamp_ns >= low - reach) & (stamp_ns <= high + reach)
    few = np.count_nonzero(use & ~near) <= FAR_SHARE * np.count_nonzero(use)
    return near if few else np.ones_like(use)


def _agreed(raw: RawTracks, frame: Array, stamp_ns: Stamps, use: Mask) -> Stamps:
    """One time per frame number, later for later frames.

    Rows of one frame with different times take the frame's median. Frames that share a time (it
    was rounded) are spread evenly between those around them. Where numbers and times contradict
    each other altogether, times count.
    """
    at = np.flatnonzero(use & np.isfinite(frame))
    if not len(at):
        return stamp_ns
    numbers, inverse = np.unique(frame[at], return_inverse=True)
    order = np.lexsort((stamp_ns[at], inverse))
    counts = np.bincount(inverse)
    first = np.append(0, np.cumsum(counts)[:-1])
    per_frame = stamp_ns[at][order][first + (counts - 1) // 2]
    falls = np.diff(per_frame) < 0
    if falls.sum() > CONTRADICTION_SHARE * len(falls):
        k = int(at[0])
        text = "frame numbers and times contradict each other; times count"
        raw.report.note(Treatment.DOUBTFUL, text, raw.place(k))
        return stamp_ns
    differ = stamp_ns[at] != per_frame[inverse]
    if differ.any():
        k = int(at[np.argmax(differ)])
        text = "another time than the rest of the frame; the frame's median is used"
        raw.report.add(Treatment.REPAIRED, int(differ.sum()), text, raw.place(k))
    times = np.maximum.accumulate(per_frame)
    changed = np.append(True, np.diff(times) > 0)
    if not changed.all():
        times = _spread(numbers, times, changed)
        shared = int(len(changed) - changed.sum())
        text = f"{shared} of {len(numbers)} frames have the time of the frame before; spread evenly"
        raw.report.note(Treatment.REPAIRED, text)
    result = stamp_ns.copy()
    result[at] = times[inverse]
    return result


def _spread(numbers: Array, times: Stamps, changed: Mask) -> Stamps:
    """Times of frames between those at which the time changes, and after the last of them."""
    known_number, known_time = numbers[changed], times[changed]
    step = np.diff(known_time) / np.diff(known_number)
    step_ns = float(np.median(step)) if len(step) else 1e9
    last_number, last_time = known_number[-1], known_time[-1]
    beyond = last_time + (numbers - last_number) * step_ns
    inside = np.interp(numbers, known_number, known_time)
    return np.where(numbers > last_number, beyond, inside).astype(np.int64)


def _ids(raw: RawTracks, use: Mask) -> NDArray[np.int32]:
    """(N,) ids of 32 bits: the file's own where they are such numbers, else counted from 1."""
    numbers = as_numbers(raw.track_id)
    known = numbers != NO_ID
    if not np.isfinite(numbers).all():
        words = pc.utf8_lower(pc.utf8_trim_whitespace(raw.track_id))
        known &= ~np.array(pc.is_in(words, value_set=pa.array(NO_ID_WORDS)), dtype=np.bool_)
    if use.any() and not known[use].any():
        found = "boxes without ids (detections, not tracks)"
        raise InputFileError(raw.report.place, found, "tracks; geoorbit track makes them")
    _leave_out(raw, use, known, "no id")
    small = np.isfinite(numbers) & (numbers == np.rint(numbers))
    small &= (numbers >= _INT32.min) & (numbers <= _INT32.max)
    if small[use].all():
        return np.where(use, np.nan_to_num(numbers), 0).astype(np.int32)
    # Words are numbered in the order in which they first appear.
    encoded = raw.track_id.dictionary_encode()
    k = int(np.argmax(use & ~small))
    count = len(encoded.dictionary)
    text = f"{count} ids are no whole numbers of 32 bits; tracks are counted from 1"
    raw.report.note(Treatment.REPAIRED, text, f"{raw.place(k)}: {raw.track_id[k]}")
    return np.array(encoded.indices, dtype=np.int32) + 1


def _scores(raw: RawTracks, use: Mask) -> NDArray[np.float32]:
    """(N,) scores from 0 to 1, whatever the detector's scale."""
    score = raw.score.astype(np.float64)
    known = np.isfinite(score) & use
    report = raw.report
    if not known.any():
        return np.ones(len(score), dtype=np.float32)
    if (use & ~known).any():
        k = int(np.argmax(use & ~known))
        count = int((use & ~known).sum())
        text = "a score that is no number; taken as sure"
        report.add(Treatment.REPAIRED, count, text, raw.place(k))
    beyond = known & ((score < 0.0) | (score > 1.0))
    if 0 < beyond.sum() <= ODD_SCORES * known.sum():  # single rows say nothing of the scale
        k = int(np.argmax(beyond))
        text = f"a score outside of 0 to 1 ({score[k]:g}); taken as sure"
        report.add(Treatment.REPAIRED, int(beyond.sum()), text, raw.place(k))
        score[beyond] = 1.0
    low, high = float(score[known].min()), float(score[known].max())
    if low < 0.0 or high > _PERCENT:
        text = f"scores from {low:g} to {high:g}: mapped to 0 to 1 by the logistic function"
        score = 1.0 / (1.0 + np.exp(-np.clip(score, -50.0, 50.0)))
        report.note(Treatment.REPAIRED, text)
    elif high > 1.0:
        percent = high > 0.2 * _PERCENT
        text = f"scores from {low:g} to {high:g}: "
        text += "taken as percent" if percent else "divided by the largest"
        score = score / (_PERCENT if percent else high)
        report.note(Treatment.REPAIRED, text)
    return np.where(np.isfinite(score), score, 1.0).astype(np.float32)


def _classes(raw: RawTracks, options: ReadOptions) -> NDArray[np.int32]:
    """(N,) COCO numbers; names that are no vehicle are noted."""
    encoded = raw.class_name.dictionary_encode()
    names = encoded.dictionary.to_pylist()
    numbers = [class_number(name, options.classes) for name in names]
    other = [n for n, number in zip(names, numbers, strict=True) if number == OTHER_CLASS]
    if other:
        shown = ", ".join(other[:6]) + (f" and {len(other) - 6} more" if len(other) > 6 else "")
        raw.report.note(Treatment.NOTED, f"no vehicle class is known by the name {shown}")
    return np.array(numbers, dtype=np.int32)[np.array(encoded.indices, dtype=np.intp)]


def _without_twins(
    raw: RawTracks, rows: NDArray[np.void], stamp_ns: NDArray[np.int64], at: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Of several boxes of one id in one frame the surest stays, the first among equals."""
    time, track_id = stamp_ns[at], rows["track_id"][at]
    later, same = time[1:] > time[:-1], time[1:] == time[:-1]
    if (later | (same & (track_id[1:] > track_id[:-1]))).all():
        return at  # ordered by time and id, as most files are
    order = np.lexsort((-rows["score"][at], rows["track_id"][at], stamp_ns[at]))
    sorted_at = at[order]
    again = (np.diff(stamp_ns[sorted_at]) == 0) & (np.diff(rows["track_id"][sorted_at]) == 0)
    if not again.any():
        return at
    twins = sorted_at[1:][again]
    k = int(twins.min())
    text = "an id twice in a frame; the box with the higher score is kept"
    example = f"{raw.place(k)}: id {rows['track_id'][k]}"
    raw.report.add(Treatment.REPAIRED, len(twins), text, example)
    place = np.stack([raw.x, raw.y])
    spread = np.ptp(np.percentile(place[:, at], (5.0, 95.0), axis=1), axis=0)
    apart = np.abs(place[:, twins] - place[:, sorted_at[:-1][again]])
    far = int(np.count_nonzero((apart > FAR_TWINS * spread[:, None]).any(axis=0)))
    if far > FAR_TWINS_SHARE * len(at):
        text = f"{far} boxes have the id of another one far away in the same frame"
        raw.report.note(Treatment.DOUBTFUL, f"{text}: are several recordings in this file?")
    return at[~np.isin(at, twins)]
