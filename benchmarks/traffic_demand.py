"""Demand from counted traffic: SUMO's routeSampler and SUMO itself on the files of a camera.

For each shipped scene a camera is simulated, `geoorbit traffic --map` counts its vehicles, SUMO's
routeSampler makes vehicles of the counts, and SUMO lets them drive; so it does with the scenario
that the command (and `geoorbit twin demand`) writes. Compared are vehicles per interval and lane at
SUMO's detectors with those counted, by the GEH statistic of hourly flows (UK Highways Agency,
Design Manual for Roads and Bridges, volume 12), and all vehicles: GEH below 5 for 95 % of lane
counts, totals within 3 %. `flowrouter` is run on its files, too. Of real cameras
(GEOORBIT_REAL_DATA names their folder) the same, on their own maps.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import sumo

from geoorbit_ros.cli.main import main as geoorbit
from geoorbit_ros.scenes.scene import shipped_scenes

INTERVAL_S, DURATION_S = 300, 600
ALLOWED_GEH, ALLOWED_TOTAL = 0.05, 0.03
TOOLS = Path(sumo.SUMO_HOME) / "tools"
PROGRAMS = Path(sys.executable).parent
Counts = Counter[tuple[str, float]]


def geh(counted: float, simulated: float, seconds: float) -> float:
    """GEH of two counts, as hourly flows."""
    m, c = (value * 3600.0 / seconds for value in (simulated, counted))
    return float(np.sqrt(2.0 * (m - c) ** 2 / (m + c))) if m + c else 0.0


def run(*command: str | Path, folder: Path) -> str:
    """Run a program; its output."""
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{command}: {done.stdout}\n{done.stderr}")
    return done.stdout


def counted_per_lane(folder: Path) -> Counts:
    """Vehicles by lane of the network and interval, as `lanedata.xml` has them."""
    found: Counts = Counter()
    for interval in Xml.parse(folder / "lanedata.xml").iter("interval"):
        for lane in interval.iter("lane"):
            found[lane.attrib["id"], float(interval.attrib["begin"])] = int(lane.attrib["entered"])
    return found


def simulated_per_lane(folder: Path, routes: str, types: str = "") -> tuple[Counts, int]:
    """Vehicles at SUMO's detectors by lane and interval, and how many arrived at all."""
    run(
        *(PROGRAMS / "sumo", "-n", "network.net.xml", "-r", routes),
        *("-a", f"{types}detectors.add.xml"),
        *("--tripinfo-output", "trips.xml", "--no-step-log", "--no-warnings", "--step-length"),
        *("0.5", "--time-to-teleport", "-1", "--seed", "1"),
        folder=folder,
    )
    with (folder / "lanes.csv").open(encoding="utf-8") as lines:
        lane_of = {
            f"station{row['station_id']}_{row['sumo_lane']}": row["sumo_lane"]
            for row in csv.DictReader(lines)
        }
    found: Counts = Counter()
    last_s = max(begin for _, begin in counted_per_lane(folder))
    for interval in Xml.parse(folder / "detected.xml").iter("interval"):
        # Those who departed in the last interval and come by after it belong to it.
        begin_s = min(float(interval.attrib["begin"]), last_s)
        found[lane_of[interval.attrib["id"]], begin_s] += int(interval.attrib["nVehContrib"])
    return found, sum(1 for _ in Xml.parse(folder / "trips.xml").iter("tripinfo"))


def flows_routed(folder: Path, network: Path) -> int:
    """Vehicles that flowrouter makes of the detectors' flows; 0 where it finds no way.

    It takes no edge that is both the first and the last one.
    """
    total, emitted = 0, folder / "emitted.xml"
    for column in ("qPKW", "qLKW"):
        emitted.unlink(missing_ok=True)
        run(
            *(sys.executable, TOOLS / "detector" / "flowrouter.py", "-n", network),
            *("-d", "detectors.add.xml", "-f", "flows.csv", "--flow-column", column),
            *("-i", str(INTERVAL_S // 60), "-o", "routed.xml", "-e", emitted.name),
            folder=folder,
        )
        flows = Xml.parse(emitted).iter("flow") if emitted.exists() else ()
        total += sum(int(float(flow.attrib["number"])) for flow in flows)
    return total


def tell(name: str, counted: Counts, simulated: Counts, arrived: int, total: int) -> None:
    """Print the shares of lane counts beyond GEH 5, and the error of all vehicles."""
    found = {key: geh(number, simulated[key], INTERVAL_S) for key, number in counted.items()}
    bad = float(np.mean([value >= 5.0 for value in found.values()]))
    error = abs(arrived - total) / total
    title = f"{name}: vehicles in SUMO"
    for what, value, allowed in (
        ("lane counts with GEH >= 5 / allowed", bad, ALLOWED_GEH),
        ("error of all vehicles / allowed", error, ALLOWED_TOTAL),
    ):
        ratio = round(value / allowed, 4)
        print(json.dumps({"name": f"{title}, {what}", "ratio": ratio, "limit": 1.0}))
    print(
        f"{name}: GEH < 5 for {1.0 - bad:.1%} of {len(found)} lane counts (median "
        f"{np.median(list(found.values())):.1f}, largest {max(found.values()):.1f}); "
        f"{arrived} of {total} vehicles",
        file=sys.stderr,
    )


def try_camera(name: str, folder: Path, network: Path, arguments: list[str]) -> None:
    """Count a camera's vehicles, and let SUMO drive them."""
    out = folder / "traffic"
    words = ["traffic", *arguments, "--map", str(network), "--interval", f"{INTERVAL_S}s"]
    assert geoorbit([*words, "--out", str(out)]) == 0, words
    files = out / "sumo"
    said = run(
        *(sys.executable, TOOLS / "routeSampler.py", "-r", "routes.rou.xml"),
        *("-d", "edgedata.xml", "-t", "turns.xml", "--keep-attributes", "--weighted"),
        *("-o", "sampled.rou.xml"),
        folder=files,
    )
    counted = counted_per_lane(files)
    data = Xml.parse(files / "od.xml").iter("edgeRelation")
    total = sum(int(pair.attrib["count"]) for pair in data)
    print(said, file=sys.stderr)
    tell(f"{name}, routeSampler", counted, *simulated_per_lane(files, "sampled.rou.xml"), total)
    scenario = simulated_per_lane(files, "demand.rou.xml", "demand.add.xml,")
    tell(f"{name}, scenario", counted, *scenario, total)
    routed = flows_routed(files, network)
    print(f"{name}: flowrouter makes {routed} vehicles of {total}", file=sys.stderr)


def cameras(names: list[str], folder: Path) -> Iterator[tuple[str, Path, Path, list[str]]]:
    """Each camera's name, folder for its files, network, and options of `geoorbit traffic`."""
    for name in names:
        place = folder / name
        words = ["scene", "run", name, "--duration", str(DURATION_S), "--seed", "1"]
        assert geoorbit([*words, "--out", str(place)]) == 0
        boxes = ["--tracks", str(place / "tracks.csv")]
        boxes += ["--calibration", str(place / "calibration.csv")]
        yield name, place, place / "network.net.xml", boxes
    real = Path(os.environ.get("GEOORBIT_REAL_DATA", "")) / "us12"
    for place in sorted(real.glob("*/osm.net.xml.gz")) if real.is_dir() else ():
        source, out = place.parent, folder / place.parent.name
        out.mkdir()
        network = out / "network.net.xml"  # flowrouter reads no packed files
        network.write_bytes(gzip.decompress(place.read_bytes()))
        boxes = ["--tracks", str(source / "trajectory.csv")]
        yield source.name, out, network, [*boxes, "--calibration", str(source / "calibration.csv")]


def main() -> None:
    """Scenes given, or all; then the real cameras."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help="Names of shipped scenes; default: all.")
    parser.add_argument("--keep", type=Path, help="Folder that the files stay in.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.keep or Path(scratch)).absolute()
        for camera in cameras(options.scenes or list(shipped_scenes()), folder):
            try_camera(*camera)


if __name__ == "__main__":
    main()
