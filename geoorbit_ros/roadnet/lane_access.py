"""Who may use which lane, by OpenStreetMap's tags, and the lanes that netconvert doesn't make.

netconvert reads few of these tags, and for right-hand traffic only. So they are read here, after
the OpenStreetMap wiki (Key:access, Lanes, Bus_lanes, Key:hov, Bicycle, Key:lanes:both_ways), and
what they say is given to netconvert as changes of its edges (`edge_patch`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from geoorbit_ros.roadnet.driving_side import Side

Tags = Mapping[str, str]
Classes = frozenset[str]

ALWAYS: Classes = frozenset({"emergency", "authority", "army", "vip"})
"""SUMO's classes that may use every lane."""
_CAR = frozenset({"private", "passenger", "hov", "evehicle"})
_PSV = frozenset({"bus", "coach", "taxi"})
_MOTOR = _CAR | _PSV | {"delivery", "truck", "trailer", "motorcycle", "moped"}
KEYS: dict[str, Classes] = {
    "access": _MOTOR | {"bicycle"},
    "vehicle": _MOTOR | {"bicycle"},
    "motor_vehicle": _MOTOR,
    "motorcar": _CAR,
    "goods": frozenset({"delivery"}),
    "hgv": frozenset({"truck", "trailer"}),
    "motorcycle": frozenset({"motorcycle"}),
    "moped": frozenset({"moped"}),
    "psv": _PSV,
    "bus": frozenset({"bus", "coach"}),
    "coach": frozenset({"coach"}),
    "taxi": frozenset({"taxi"}),
    "hov": frozenset({"hov"}),
    "tram": frozenset({"tram"}),
    "bicycle": frozenset({"bicycle"}),
    "emergency": ALWAYS,
}
"""SUMO's classes of OpenStreetMap's keys, from the general to the particular (wiki, Key:access)."""
_GENERAL = ("access", "vehicle", "motor_vehicle", "motorcar")
_OPEN = frozenset({"yes", "designated", "official", "permissive", "lane", "only"})
_RESERVED = frozenset({"designated", "official", "lane", "only"})
_CLOSED = frozenset({"no", "use_sidepath"})
CYCLE_LANE_M = 1.5
"""Width of cycle lanes. Chosen: between the 1 m of netconvert and the 2 m of UK LTN 1/20; wider
takes more of the road from the lanes beside."""


@dataclass(frozen=True, slots=True)
class LanePlan:
    """A lane as it should be.

    Attributes:
        allowed: SUMO's classes that may use it.
        width_m: Its width; None: the usual one.
        both_ways: Whether it is for turns from both sides.
    """

    allowed: Classes
    width_m: float | None = None
    both_ways: bool = False


@dataclass(slots=True)
class WayCounts:
    """Ways whose tags could not be followed, by their numbers.

    Attributes:
        unclear: Lists of lanes that don't fit the number of lanes.
        hours: Rules for certain hours, which are not read.
        cycle_lanes: Cycle lanes between other lanes, or against the traffic: not made.
    """

    unclear: list[str] = field(default_factory=list)
    hours: list[str] = field(default_factory=list)
    cycle_lanes: list[str] = field(default_factory=list)


def prepared(tags: Tags) -> dict[str, str]:
    """A road's tags as netconvert is to read them: without those that are read here.

    The lane in the middle of the road for turns from both sides does not count: it is added later.
    A bus lane against a one-way road is the one thing that netconvert makes itself.
    """
    left_out = ("busway", "cycleway", "oneway:bicycle", "oneway:psv", "sidewalk")
    kept = {key: value for key, value in tags.items() if not key.startswith(left_out)}
    if _is_oneway(tags) and _has_contraflow_bus(tags):
        kept["oneway:bus"] = "no"
    middle = middle_lanes(tags)
    if middle:
        total, ahead, back = (_count(tags, f"lanes{end}") for end in ("", ":forward", ":backward"))
        if total is not None and ahead is None and back is None:
            ahead = -(-(total - middle) // 2)
        if total is not None:
            back = total - middle - (ahead or 0) if back is None else back
            ahead = total - middle - back if ahead is None else ahead
        if ahead and back:
            kept |= {"lanes": str(ahead + back), "lanes:forward": str(ahead)}
            kept["lanes:backward"] = str(back)
    return kept


def middle_lanes(tags: Tags) -> int:
    """How many lanes for turns from both sides a road has in its middle."""
    if _is_oneway(tags):
        return 0
    if (stated := _count(tags, "lanes:both_ways")) is not None:
        return min(stated, 1)
    return int("yes" in (tags.get("centre_turn_lane"), tags.get("center_turn_lane")))


def lane_plans(
    number: str, tags: Tags, forward: bool, side: Side, usual: list[Classes], counts: WayCounts
) -> list[LanePlan]:
    """The lanes of a road in one direction, by SUMO's index: the outermost first.

    Args:
        number: Of the way.
        tags: As in the map.
        forward: Along the way, or back.
        side: Where traffic drives.
        usual: Who may use each lane by the kind of road, by index.
        counts: Gets the way where its tags can't be followed.
    """
    if any(key.endswith(":conditional") and "lanes" in key for key in tags):
        counts.hours.append(number)
    alone = _is_oneway(tags)
    contraflow = alone and forward == (tags.get("oneway") in ("-1", "reverse"))
    if contraflow:
        return [LanePlan(KEYS["bus"] | ALWAYS | {"bicycle"})] * len(usual)
    lists = _lists(tags, forward, alone)
    plans = [LanePlan(_by_way(classes, tags, forward)) for classes in usual]
    order = range(len(plans) - 1, -1, -1) if side == "right" else range(len(plans))
    cycle_outside = _cycle_lane(number, tags, forward, side, counts)
    lists, listed_outside = _without_cycle_lanes(number, lists, len(plans), side, counts)
    if any(len(values) != len(plans) for values in lists.values()):
        counts.unclear.append(number)
        lists = {key: values for key, values in lists.items() if len(values) == len(plans)}
    for position, index in enumerate(order):
        own = {key: values[position] for key, values in lists.items()}
        plans[index] = LanePlan(_by_lane(plans[index].allowed, own))
    for key, lanes in _reserved(tags, forward, alone, side, len(plans)).items():
        group = {"hov"} if key == "hov" else {"psv", "bus", "taxi"}
        if not any(name in lists or f"{name}:lanes" in tags for name in group):
            for index in lanes:
                plans[index] = LanePlan(KEYS[key] | ALWAYS | ({"bicycle"} & plans[index].allowed))
    if cycle_outside or listed_outside:
        plans = [LanePlan(frozenset({"bicycle"}), CYCLE_LANE_M)] + [
            replace(plan, allowed=plan.allowed - {"bicycle"}) for plan in plans
        ]
    return plans + [LanePlan(ALWAYS, both_ways=True)] * middle_lanes(tags)


def _by_way(usual: Classes, tags: Tags, forward: bool) -> Classes:
    """Who may use all lanes of a road: what its kind says, changed by its own tags."""
    allowed = set(usual)
    direction = "forward" if forward else "backward"
    for key, classes in KEYS.items():
        value = tags.get(f"{key}:{direction}", tags.get(key, ""))
        if value in _CLOSED:
            allowed -= classes - ALWAYS
        elif value in _OPEN and key not in ("access", "emergency", "tram"):
            allowed |= classes
    if tags.get("hov") == "designated":
        allowed -= _CAR - {"hov"}
    return frozenset(allowed)


def _by_lane(usual: Classes, own: Tags) -> Classes:
    """Who may use one lane, by its own values of the lists.

    A lane designated for buses, taxis, bicycles, or full cars is for them alone, unless a list says
    that others may use it, too: mappers often leave out the list that closes it to others.
    """
    allowed = set(usual)
    for key, classes in KEYS.items():
        if own.get(key) in _CLOSED:
            allowed -= classes - ALWAYS
        elif own.get(key) in _OPEN:
            allowed |= classes
    reserved = [k for k in KEYS if k not in _GENERAL and own.get(k) in _RESERVED]
    if reserved and not any(own.get(key) in _OPEN for key in _GENERAL):
        stated = [k for k in KEYS if k not in _GENERAL and own.get(k) in _OPEN]
        allowed = {c for k in stated for c in KEYS[k]} | (allowed & ALWAYS)
    return frozenset(allowed)


def _lists(tags: Tags, forward: bool, alone: bool) -> dict[str, list[str]]:
    """The lists `bus:lanes=yes|designated` of one direction by key, from left to right."""
    end = ":forward" if forward else ":backward"
    found = {}
    for key in KEYS:
        text = tags.get(f"{key}:lanes{end}")
        if text is None and (alone or forward):
            text = tags.get(f"{key}:lanes")
        if text is not None:
            found[key] = [value.strip() for value in text.split("|")]
    return found


def _without_cycle_lanes(
    number: str, lists: dict[str, list[str]], lanes: int, side: Side, counts: WayCounts
) -> tuple[dict[str, list[str]], bool]:
    """The lists without lanes for bicycles alone, which `lanes` does not count.

    Returns:
        The lists, and whether such a lane is the outermost.
    """
    longest = max(map(len, lists.values()), default=0)
    if longest <= lanes:
        return lists, False
    own = [
        {key: values[k] for key, values in lists.items() if len(values) == longest}
        for k in range(longest)
    ]
    cycle = [
        value.get("bicycle") in _RESERVED
        and (
            "bicycle" in lists
            and not any(value.get(key) in _OPEN for key in KEYS if key != "bicycle")
        )
        for value in own
    ]
    if longest - sum(cycle) != lanes:
        return lists, False
    outer = longest - 1 if side == "right" else 0
    if sum(cycle) > cycle[outer]:
        counts.cycle_lanes.append(number)
    kept = {
        key: [v for v, lane in zip(values, cycle, strict=True) if not lane]
        for key, values in lists.items()
        if len(values) == longest
    }
    return {**lists, **kept}, cycle[outer]


def _reserved(
    tags: Tags, forward: bool, alone: bool, side: Side, lanes: int
) -> dict[str, list[int]]:
    """Indices of lanes that are reserved by number (`lanes:psv=1`) or by side (`busway=lane`)."""
    end = ":forward" if forward else ":backward"
    found: dict[str, list[int]] = {}
    for key in ("psv", "bus", "taxi", "hov"):
        count = _count(tags, f"lanes:{key}{end}")
        both = _count(tags, f"lanes:{key}")
        if count is None and both is not None:
            count = both if alone else (both + 1) // 2 if forward else both // 2
        count = min(count or 0, lanes)
        if key == "hov":  # high-occupancy lanes are the inner ones, bus lanes the outer ones
            if not count and tags.get("hov") == "lane":
                count = 1
            found[key] = list(range(lanes - count, lanes))
        else:
            found[key] = list(range(count))
    outer: Side = "right" if (side == "right") == forward else "left"  # of the way, not of traffic
    for place in ("", ":both", ":left", ":right"):
        if tags.get(f"busway{place}") != "lane":
            continue
        if place in ("", ":both") or place == f":{outer}":
            found["bus"] = found["bus"] or [0]
        elif alone:
            found["bus"] = found["bus"] or [lanes - 1]
    return {key: indices for key, indices in found.items() if indices}


def _cycle_lane(number: str, tags: Tags, forward: bool, side: Side, counts: WayCounts) -> bool:
    """Whether a cycle lane lies outside the outermost lane, in the direction of traffic."""
    outer = "right" if (side == "right") == forward else "left"
    inner = "left" if outer == "right" else "right"
    alone = _is_oneway(tags)
    given = {
        place: tags.get(f"cycleway:{place}", tags.get("cycleway:both", tags.get("cycleway", "")))
        for place in ("left", "right")
    }
    back = [p for p in given if tags.get(f"cycleway:{p}:oneway") in ("-1", "no")]
    against = "opposite_lane" in tags.values() or (
        alone and any(given[place] == "lane" for place in back)
    )
    if alone and (against or (given[inner] == "lane" and given[outer] != "lane")):
        counts.cycle_lanes.append(number)
    return given[outer] == "lane" and not (alone and outer in back)


def _has_contraflow_bus(tags: Tags) -> bool:
    opposite = [v for k, v in tags.items() if k.startswith("busway") and v.startswith("opposite")]
    return bool(opposite) or "no" in (tags.get("oneway:bus"), tags.get("oneway:psv"))


def _is_oneway(tags: Tags) -> bool:
    if (stated := tags.get("oneway")) is not None:
        return stated in ("yes", "true", "1", "-1", "reverse")
    round_about = tags.get("junction") in ("roundabout", "circular")
    return round_about or tags.get("highway") in ("motorway", "motorway_link")


def _count(tags: Tags, key: str) -> int | None:
    text = tags.get(key, "").strip()
    return int(text) if text.isascii() and text.isdigit() else None
