"""Parameters of the node `sumo_bridge`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SumoBridgeParameters:
    """See params/sumo_bridge.yaml."""

    network: str
    cameras: str
    calibrations: str
    image_sizes: str
    datum_latitude_deg: float
    datum_longitude_deg: float
    step_s: float
    hold_s: float
    backend: str
    gui: bool
    publish_clock: bool
    health_period_s: float
    frame_id: str
    reliability: str
    queue_depth: int
    restart_jump_s: float
    map_check_period_s: float
    align: bool
    closed_lanes: str
    speed_limits: str
    forecast_minutes: float
    forecast_window_s: float
    forecast_limit_s: float
    side_by_side_period_s: float
