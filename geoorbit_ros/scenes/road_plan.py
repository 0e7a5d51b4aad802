"""What a scene file says about roads: pieces, places, lanes."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from geoorbit_ros.storage.yaml_file import StrictModel, WrongValue

Positive = Annotated[float, Field(gt=0.0)]
Length = Annotated[float, Field(ge=1.0, le=5000.0)]


class Straight(StrictModel):
    """A straight piece of road."""

    straight_m: Length

    @property
    def radius_m(self) -> float:
        """Infinite."""
        return float("inf")

    @property
    def turn_deg(self) -> float:
        """None."""
        return 0.0

    def length_m(self, left_m: float = 0.0) -> float:
        """Length of the line `left_m` to the left: the same everywhere."""
        return self.straight_m


class Bend(StrictModel):
    """An arc; positive `turn_deg` bends to the left."""

    radius_m: Length
    turn_deg: float = Field(ge=-270.0, le=270.0)

    @model_validator(mode="after")
    def _long_enough(self) -> Bend:
        if self.length_m() < 1.0:
            found = f"{self.turn_deg:g}, an arc of {self.length_m():.3f} m"
            raise WrongValue(("turn_deg",), found, "at least 1 m of arc")
        return self

    def length_m(self, left_m: float = 0.0) -> float:
        """Length of the line `left_m` to the left, shorter inside the bend."""
        inside = left_m if self.turn_deg > 0 else -left_m
        return (self.radius_m - inside) * abs(math.radians(self.turn_deg))


def _kind_of_piece(piece: Any) -> str | None:
    if isinstance(piece, Straight | Bend):
        return "straight" if isinstance(piece, Straight) else "bend"
    if isinstance(piece, dict):
        return "straight" if "straight_m" in piece else "bend"
    return None


Piece = Annotated[
    Annotated[Straight, Tag("straight")] | Annotated[Bend, Tag("bend")],
    Discriminator(
        _kind_of_piece,
        custom_error_type="piece",
        custom_error_message="'{straight_m: …}' or '{radius_m: …, turn_deg: …}'",
    ),
]


class Start(StrictModel):
    """Where a road's left border begins, and its heading clockwise from north."""

    x_m: float
    y_m: float
    heading_deg: float


class LaneRef(StrictModel):
    """One lane of a road; lane 0 is the rightmost."""

    road: str
    lane: int = Field(ge=0)


class Opposite(StrictModel):
    """Beside another road, in the other direction, `median_m` between the left borders."""

    road: str
    median_m: float = Field(ge=0.0)


class Road(StrictModel):
    """A one-way road.

    Exactly one of `start`, `follows`, `leaves`, `joins` and `opposite` says where it lies.

    Attributes:
        id: Its name.
        lanes: Number of lanes.
        path: Pieces in travel order, along the left border.
        speed_kmh: Speed limit.
        start: Its left border begins here.
        follows: It begins where that road ends, left borders aligned.
        leaves: It begins at the end of that lane (an off-ramp).
        joins: It ends at the beginning of that lane (an on-ramp).
        opposite: It is the other carriageway of that road, and takes its shape from it.
        lane_width_m: Overrides the scene's.
        yellow_left_line: Whether the line at its left border is yellow, as in North America.
    """

    id: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    lanes: int = Field(ge=1, le=8)
    path: list[Piece] = Field(default=[])
    speed_kmh: Positive = 100.0
    start: Start | None = None
    follows: str | None = None
    leaves: LaneRef | None = None
    joins: LaneRef | None = None
    opposite: Opposite | None = None
    lane_width_m: float | None = Field(default=None, ge=2.5, le=5.0)
    yellow_left_line: bool = False

    @model_validator(mode="after")
    def _one_place(self) -> Road:
        places = ("start", "follows", "leaves", "joins", "opposite")
        given = [name for name in places if getattr(self, name) is not None]
        if len(given) != 1:
            raise WrongValue((), " and ".join(given) or "no place", f"one of {', '.join(places)}")
        if bool(self.path) == bool(self.opposite):
            expected = "no path, 'opposite' gives it" if self.opposite else "at least one"
            raise WrongValue(("path",), f"{len(self.path)} pieces", expected)
        return self

    @property
    def anchor(self) -> str | None:
        """The road that this one's place depends on."""
        ref = self.leaves or self.joins or self.opposite
        return ref.road if ref else self.follows


class RoadPoint(StrictModel):
    """A point seen from a road: metres along its left border, and to the right of it."""

    road: str
    along_m: float = Field(ge=0.0)
    right_m: float = 0.0
