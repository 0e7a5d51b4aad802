"""Writes a SUMO scenario of a day: flows per interval, way and class of vehicles."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

from geoorbit_ros.roadnet.network_file import read_unpacked
from geoorbit_ros.twin.demand.count_files import SumoCounts
from geoorbit_ros.twin.demand.vehicle_types import add_types, departure, type_names

NETWORK, FLOWS, TYPE_FILE, CONFIG = (
    "network.net.xml",
    "demand.rou.xml",
    "demand.add.xml",
    "demand.sumocfg",
)
STEP_S = 0.5
"""Length of a step; see `forecast.files.STEP_S`."""
SPREAD = 0.6180339887498949
"""Flows begin at multiples of the golden ratio within the time between two vehicles, so that they
don't all begin at once (H. Weyl 1916, "Über die Gleichverteilung von Zahlen mod. Eins")."""
LAST_S = 600.0
"""The simulation goes on so long after the last interval. Chosen: vehicles leave a stretch of some
kilometres in it; it ends sooner if they do."""


def write_scenario(folder: Path, counts: SumoCounts) -> Path:
    """Write network, types, flows and configuration; the path of the configuration.

    Vehicles depart at the beginning of their first edge, in the lane in which they were seen, as
    fast as the vehicles of their class drove in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if counts.network.path != folder / NETWORK:  # as netconvert has built it there
        (folder / NETWORK).write_bytes(read_unpacked(counts.network.path, "a SUMO network"))
    types = Xml.Element("additional")
    add_types(types, counts.network, counts.vehicles)
    _save(types, folder / TYPE_FILE)
    _save(_flows(counts), folder / FLOWS)
    _save(_config(counts), folder / CONFIG)
    return folder / CONFIG


def _flows(counts: SumoCounts) -> Xml.Element:
    root, number = Xml.Element("routes"), 0
    ways, names = counts.vehicles.ways, type_names(counts.network, counts.vehicles)
    routes = sorted({way.edges for way in ways})
    for k, edges in enumerate(routes):
        Xml.SubElement(root, "route", id=f"route{k + 1}", edges=" ".join(edges))
    for k, begin, end in counts.intervals():
        flows = []
        for w in counts.counts.count[k].nonzero()[0].tolist():
            number += 1
            vehicles = int(counts.counts.count[k, w])
            shift = (number * SPREAD % 1.0) * (end - begin) / vehicles
            # SUMO's flow lasts from its first vehicle to one gap after its last.
            flows.append((begin + shift, end + shift, vehicles, w))
        for start, stop, vehicles, w in sorted(flows):
            values = {
                "id": f"flow{begin:.0f}_{w + 1}",
                "type": names[w],
                "route": f"route{routes.index(ways[w].edges) + 1}",
                "begin": f"{start:.2f}",
                "end": f"{stop:.2f}",
                "number": str(vehicles),
            }
            Xml.SubElement(root, "flow", values | departure(counts.edges, ways[w]))
    return root


def _config(counts: SumoCounts) -> Xml.Element:
    root, intervals = Xml.Element("sumoConfiguration"), list(counts.intervals())
    files = Xml.SubElement(root, "input")
    for name, value in (
        ("net-file", NETWORK),
        ("route-files", FLOWS),
        ("additional-files", TYPE_FILE),
    ):
        Xml.SubElement(files, name, value=value)
    time = Xml.SubElement(root, "time")
    Xml.SubElement(time, "begin", value=f"{intervals[0][1]:.2f}")
    Xml.SubElement(time, "end", value=f"{intervals[-1][2] + LAST_S:.2f}")
    Xml.SubElement(time, "step-length", value=f"{STEP_S:g}")
    processing = Xml.SubElement(root, "processing")
    Xml.SubElement(processing, "time-to-teleport", value="-1")
    return root


def _save(root: Xml.Element, path: Path) -> None:
    Xml.indent(root)
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
