"""A fleet for minutes on end: nothing piles up, memory stays flat, how late tracks and lanes are.

`rendered`: four cameras along one road, with detector, tracker, homography, lane map, recorder and
meta_client each, a federated server and the SUMO twin of the road. Their images are drawn
beforehand and played as videos: drawing takes more than looking, and no real camera does it.
`tracks`: eight cameras from recorded boxes, with homography, lane map and recorder each.

Memory is resident memory, of each process and of all; its slope is fitted after the warm-up, with
the error of the fit. The cameras begin as they are after hours, with their lanes' evidence full:
until then one remembers more vehicles each minute, up to 1500 (`--young`: begin with nothing). The
twin remembers ten minutes of traffic, for forecasts: hence the warm-up.
Latency is from the stamp of a frame, the time at which it was due, to the arrival of its `tracks`
or its `lanes` here. A backlog would show as drift: how much later the last quarter of the frames
is than the first.

    python benchmarks/fleet_soak.py [--kind rendered] [--kind tracks] [--minutes 10] [--young]
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import yaml

from geoorbit_ros.nodes.support.composition import Composition
from soak.findings import draw, figures, print_tables, write_memory
from soak.fleets import ImageFormat, rendered_fleet, tracks_fleet
from soak.long_running import fill_memories
from soak.watch import Samples, Watch

START_LIMIT_S = 120.0
STOP_LIMIT_S = 30.0
LATENCY_LIMIT_MS = 150.0
NAMES = {"rendered": "fleet of 4 rendered cameras", "tracks": "fleet of 8 trajectory cameras"}


def run(
    content: dict[str, Any], name: str, minutes: float, folder: Path, *, young: bool
) -> Samples:
    """Run a fleet for so long, and watch it."""
    with Composition(quiet=True) as nodes:
        fleet, log = folder / f"{name}.yaml", folder / f"{name}.log"
        content = {"name": name, "domain_id": nodes.domain_id, **content}
        fleet.write_text(yaml.safe_dump(content, sort_keys=False))
        words = [sys.executable, "-m", "geoorbit_ros.cli.main", "up", str(fleet)]
        with tempfile.TemporaryDirectory() as out, log.open("wb") as stream:
            if not young:
                fill_memories(content["cameras"], folder, Path(out))
            process = subprocess.Popen([*words, "--out", out], stdout=stream, stderr=stream)
            try:
                watch = Watch(nodes, [camera["id"] for camera in content["cameras"]], log)
                nodes.wait(
                    lambda: "processes run" in log.read_text() or process.poll() is not None,
                    START_LIMIT_S,
                    "a fleet that runs",
                )
                samples = watch.run(minutes)
            finally:
                process.send_signal(signal.SIGINT)
                process.wait(STOP_LIMIT_S)
    if restarts := log.read_text().count("again in"):
        samples.problems.append(f"{restarts} restarts, see {log}")
    return samples


def report(kind: str, found: dict[str, Any]) -> None:
    """The ratios that `./dev bench` shows."""
    cameras = found["cameras"].values()
    frames = sum(camera["tracks"]["messages"] for camera in cameras)
    p99_ms = max(camera["tracks"].get("p99_ms", float("nan")) for camera in cameras)
    for what, ratio, limit in (
        ("frames lost / frames", sum(c["lost"] for c in cameras) / max(frames, 1), 0.0),
        (f"p99 latency / {LATENCY_LIMIT_MS:g} ms", p99_ms / LATENCY_LIMIT_MS, 1.0),
        ("memory's slope / twice its error", found["all"]["slope_over_noise"], 1.0),
        ("processor time / two cores", found["all"]["cores"] / 2.0, 1.0),
    ):
        name = f"{NAMES[kind]}, {what}"
        print(json.dumps({"name": name, "ratio": round(ratio, 5), "limit": limit}), flush=True)


def main() -> int:
    """Run the fleets that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", action="append", choices=tuple(NAMES))
    parser.add_argument("--minutes", type=float, default=10.0, help="that count")
    parser.add_argument("--warm-up", type=float, default=10.0, help="minutes before them")
    parser.add_argument("--young", action="store_true", help="cameras that know no traffic yet")
    parser.add_argument("--size", default="640x360", help="of the rendered images")
    parser.add_argument("--fps", type=float, default=10.0, help="of the rendered images")
    parser.add_argument(
        "--out", type=Path, default=Path("out/soak"), help="films, figures, drawings"
    )
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    images = ImageFormat(width, height, options.fps)
    folder = options.out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    warm_min = options.warm_up
    for kind in options.kind or NAMES:
        content = rendered_fleet(folder, images) if kind == "rendered" else tracks_fleet(folder)
        samples = run(content, kind, warm_min + options.minutes, folder, young=options.young)
        found = figures(samples, options.minutes, warm_min)
        print_tables(kind, found)
        (folder / f"{kind}.json").write_text(json.dumps(found, indent=1) + "\n")
        write_memory(samples, folder / f"{kind}-memory.csv")
        draw(samples, warm_min, NAMES[kind], folder / f"{kind}.png")
        print(f"figures: {folder / kind}.json, drawing: {folder / kind}.png", file=sys.stderr)
        report(kind, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
