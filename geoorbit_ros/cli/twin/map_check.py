"""`geoorbit twin validate` and `twin patch`: detected lanes against a map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import ForceOption

if TYPE_CHECKING:
    from geoorbit_ros.mapcheck.validation import Validation

LanesArgument = Annotated[Path, typer.Argument(help="Detected lanes: lanes.geojson.")]
NetOption = Annotated[
    Path, typer.Option("--net", help="SUMO network with a projection (geoorbit map build).")
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; new or empty.")]


def validate(
    lanes: LanesArgument, net: NetOption, out: OutOption, force: ForceOption = False
) -> None:
    """Say where a map differs from the lanes that a camera sees vehicles drive along.

    First the lanes are laid on the map as a whole, then they are compared: lanes that one of them
    lacks, other places, other widths, other directions. Into the folder go report.json and
    validation.png.

    Example: [bold]geoorbit twin validate lanes.geojson --net area/network.net.xml
    --out check[/bold]
    """
    import json

    from geoorbit_ros.cli.console import console, read_lanes_aloud
    from geoorbit_ros.mapcheck.validation import validate as compare
    from geoorbit_ros.mapcheck.validation_image import save_validation
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.storage.atomic import atomic_output

    with atomic_output(out, overwrite=force) as folder:
        file = read_lanes_aloud(lanes)
        network = load_network(net, file.datum)
        found = compare(file.lane_map.lanes, network)
        folder.mkdir()
        text = json.dumps(found.record(file.datum), indent=2, ensure_ascii=False)
        (folder / "report.json").write_text(text + "\n", encoding="utf-8")
        title = f"{net.name} as seen by {file.camera_id or lanes.name}"
        save_validation(folder / "validation.png", file.lane_map.lanes, network, found, title)
    _print_findings(found)
    console.print(f" Wrote {out}", soft_wrap=True)


def patch(lanes: LanesArgument, net: NetOption, out: OutOption, force: ForceOption = False) -> None:
    """Correct a map by the lanes that a camera sees, as far as they differ (twin validate).

    Into the folder go network.net.xml, loaded and validated again; patch/ with the plain XML that
    netconvert made it of (patch.edg.xml and patch.con.xml are the changes); patch.json with the
    findings before and after and netconvert's options; before.png and after.png.

    Example: [bold]geoorbit twin patch lanes.geojson --net area/network.net.xml --out new[/bold]
    """
    import json

    from geoorbit_ros.cli.console import console, count_of, read_lanes_aloud, say, status
    from geoorbit_ros.mapcheck.patch import patch_network
    from geoorbit_ros.mapcheck.validation_image import save_validation
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.storage.atomic import atomic_output

    with atomic_output(out, overwrite=force) as folder:
        file = read_lanes_aloud(lanes)
        network = load_network(net, file.datum)
        folder.mkdir()
        seen = file.lane_map.lanes
        with status("patching the network"):
            result = patch_network(seen, network, folder)
        text = json.dumps(result.record(file.datum), indent=2, ensure_ascii=False)
        (folder / "patch.json").write_text(text + "\n", encoding="utf-8")
        name = file.camera_id or lanes.name
        for image, road, found, title in (
            ("before.png", network, result.before, f"{net.name} as seen by {name}"),
            ("after.png", result.network, result.after, f"patched: {net.name} as seen by {name}"),
        ):
            save_validation(folder / image, seen, road, found, title)
    _print_findings(result.before)
    say(
        f"{count_of(len(result.done), 'finding')} corrected, {len(result.left)} left; the patched "
        f"map has {count_of(len(result.after.findings), 'finding')}."
    )
    for finding, reason in result.left:
        say(f"Left: {finding.sentence}: {reason}.")
    for finding in result.after.findings:
        say(f"Still: {finding.sentence}.")
    console.print(f" Wrote {out}", soft_wrap=True)


def _print_findings(found: Validation) -> None:
    from geoorbit_ros.cli.console import console, make_table, say
    from geoorbit_ros.mapcheck.validation import say_alignment

    if found.findings:
        table = make_table("What differs", "kind|>sure|>allowed|finding")
        for f in found.findings:
            allowed = f"{f.tolerance:.2f} m" if f.unit == "m" else ""
            sentence = "see below" if f.kind == "offset" else f.sentence
            table.add_row(f.kind, f"{f.confidence:.0%}", allowed, sentence)
        console.print(table)
    say(say_alignment(found.alignment))
    if not found.findings:
        say(f"No findings in {len(found.discrepancies.compared)} lanes.")
    for note in (*found.notes, *(unseen.sentence for unseen in found.discrepancies.unseen)):
        say(f"{note[0].upper()}{note[1:]}.")
