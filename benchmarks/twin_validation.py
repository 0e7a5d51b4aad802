"""Errors planted into every shipped scene's map, found and corrected by what its camera sees.

A minute of traffic goes through camera model, detector model and lane estimator. The scene's own
network is right; it is given one error at a time: a lane missing, a lane too many, an edge 1 m
beside its place, a lane 0.8 m narrower, an edge turned round, the whole map displaced by 1 m. Every
lane that the camera checks over `MIN_LENGTH_M` takes its turn. An error counts as found when one
finding has its kind and place and, within the stated tolerance, its size, and no finding is of
anything else (an extra lane with too little traffic beside it is counted apart: the report says how
many vehicles it takes; a displaced edge may be reported as a displaced map where that explains all
that is seen); as corrected when the patched network has no finding and every lane the camera checks
lies, is as wide and runs as in the right one, as well as the camera's own lanes do (`CORRECTED_M`,
`CORRECTED_WIDTH_M`).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation import Validation, validate
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.random_scene import RandomSceneError, random_scene
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import simulate
from scores.map_errors import SHIFT_M, WIDTH_M, Error, plant

DURATION_S = 60.0
MIN_LENGTH_M = 30.0
"""An error can move an edge's end by some metres; of less than 20 m in view nothing is checked."""
CORRECTED_M, CORRECTED_WIDTH_M = 0.4, 0.3
"""What the lane estimator promises of a lane at 95 %, and the least width difference reported."""


def seen(scene: Scene, seed: int, folder: Path) -> tuple[Sequence[Lane], RoadNetwork]:
    """A scene's lanes as its camera finds them, and its network."""
    run = simulate(scene, DURATION_S, seed)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    mapper = LaneMapper(make_estimator("curvilinear"))
    lanes = map_lanes(project_frames(run.frames, projector), mapper).lanes
    net = write_network(place_roads(scene), folder, run.datum)
    return lanes, load_network(net, run.datum)


def is_found(error: Error, lane: str, found: Validation) -> bool:
    """Whether a validation says what was planted, and nothing else."""
    sizes = {"shifted": SHIFT_M, "offset": SHIFT_M, "width": WIDTH_M}
    edge = lane.rpartition("_")[0]
    kinds = {error}
    if error == "shifted" and len(found.findings) == 1:
        kinds.add("offset")  # the only one: it explains all that is seen
    matching = [f for f in found.findings if f.kind in kinds]
    if not matching or len(matching) < len(found.findings):
        return False
    if any(f.kind != "offset" and f.lane_id.rpartition("_")[0] != edge for f in matching):
        return False
    if error in ("extra", "width") and [f.lane_id for f in matching] != [lane]:
        return False
    if error not in sizes:
        return True
    off = [abs(abs(f.measured - f.expected) - sizes[error]) for f in matching]
    return all(o <= f.tolerance for o, f in zip(off, matching, strict=True))


def is_corrected(lanes: Sequence[str], right: RoadNetwork, patched: RoadNetwork) -> bool:
    """Whether the lanes of a right network are in a patched one, and no other beside them."""
    checked = {name.rpartition("_")[0] for name in lanes}
    for edge in checked:
        if right.edge_id.count(edge) != patched.edge_id.count(edge):
            return False
    return all(_has(right, right.number[name], patched) for name in lanes)


def _has(right: RoadNetwork, k: int, patched: RoadNetwork) -> bool:
    points = sample(right.line(k))
    for m in range(len(patched)):
        if patched.edge_id[m] != right.edge_id[k]:
            continue
        foot = project(points.point_m, patched.line(m), 1.0)
        if not foot.inside.any():
            continue
        same = np.median(np.sum(points.tangent * foot.tangent, axis=1)) > 0.9
        near = np.median(np.abs(foot.offset_m[foot.inside])) <= CORRECTED_M
        wide = abs(patched.width_m[m] - right.width_m[k]) <= CORRECTED_WIDTH_M
        if same and near and wide:
            return True
    return False


def is_inner(network: RoadNetwork, lane: str) -> bool:
    """Whether there are lanes on both sides: no room for another one."""
    k = network.number[lane]
    return bool(network.left[k] >= 0 and network.right[k] >= 0)


def try_right(
    name: str, lanes: Sequence[Lane], network: RoadNetwork, counts: Counter[str]
) -> Validation:
    """A right map."""
    clean = validate(lanes, network)
    counts["right maps"] += 1
    counts["right maps with findings"] += bool(clean.findings)
    for finding in clean.findings:
        print(f"{name}, right map: {finding.sentence}", file=sys.stderr)
    return clean


def try_drawn(seed: int, counts: Counter[str]) -> None:
    """The right map of a scene drawn at random."""
    try:
        scene = random_scene(seed)
        with tempfile.TemporaryDirectory() as text:
            lanes, network = seen(scene, seed, Path(text))
            try_right(f"drawn scene {seed}", lanes, network, counts)
    except (RandomSceneError, NoTrafficError) as error:
        print(f"drawn scene {seed}: {error}", file=sys.stderr)


def try_scene(name: str, seed: int, counts: Counter[str]) -> None:
    """All errors in all lanes of a scene."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        lanes, network = seen(load_scene(name), seed, folder)
        clean = try_right(f"{name}, seed {seed}", lanes, network, counts)
        checked = [k for k, m in clean.discrepancies.compared.items() if m >= MIN_LENGTH_M]
        for error in get_args(Error):
            for k, lane in enumerate(checked):
                alone = network.edge_id.count(network.edge_id[network.number[lane]]) == 1
                if (error == "missing" and alone) or (error == "offset" and k):
                    continue
                if error == "extra" and is_inner(network, lane):
                    continue
                work = folder / f"{error}_{k}"
                (work / "plain").mkdir(parents=True)
                named = plant(error, network, lane, work / "bad.net.xml", work / "plain")
                bad = load_network(work / "bad.net.xml", network.datum)
                (work / "out").mkdir()
                result = patch_network(lanes, bad, work / "out")
                found = is_found(error, named, result.before)
                corrected = not result.after.findings and is_corrected(
                    checked, network, result.network
                )
                unseen = {u.lane_id for u in result.before.discrepancies.unseen}
                if error == "extra" and named in unseen and not result.before.findings:
                    counts["undecided"] += 1  # said so, with the number of vehicles it takes
                    continue
                counts[f"{error} planted"] += 1
                counts[f"{error} found"] += found
                counts[f"{error} corrected"] += corrected
                if not (found and corrected):
                    said = [f.sentence for f in result.before.findings]
                    said += [u.sentence for u in result.before.discrepancies.unseen]
                    after = [f.sentence for f in result.after.findings]
                    print(
                        f"{name}, seed {seed}, {error} {lane}: found {found}, "
                        f"corrected {corrected}; said {said}; after {after}",
                        file=sys.stderr,
                    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--scenes", nargs="*", default=shipped_scenes())
    parser.add_argument(
        "--drawn",
        type=int,
        nargs=2,
        default=[0, 0],
        metavar=("FIRST", "END"),
        help="right maps of scenes drawn at random, seeds from FIRST to before END",
    )
    given = parser.parse_args()
    counts: Counter[str] = Counter()
    for seed in given.seeds:
        for name in given.scenes:
            try_scene(name, seed, counts)
    for seed in range(*given.drawn):
        try_drawn(seed, counts)
    for error in get_args(Error):
        planted, found = counts[f"{error} planted"], counts[f"{error} found"]
        if not planted:
            continue
        corrected = counts[f"{error} corrected"]
        print(f"{error}: {planted} planted, {found} found, {corrected} corrected", file=sys.stderr)
        for what, number in (("missed", planted - found), ("not corrected", planted - corrected)):
            title = f"map errors, {error}: {what} of {planted}"
            print(json.dumps({"name": title, "ratio": round(number / planted, 4), "limit": 0.0}))
    print(f"{counts['undecided']} extra lanes with too little traffic beside them", file=sys.stderr)
    wrong, maps = counts["right maps with findings"], counts["right maps"]
    title = f"right maps with a finding, of {maps}"
    print(json.dumps({"name": title, "ratio": round(wrong / maps, 4), "limit": 0.0}))


if __name__ == "__main__":
    main()
