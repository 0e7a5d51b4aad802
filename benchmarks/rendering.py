"""Cost of a rendered image beside the time between two frames of a camera.

1280x720 at 25 frames per second, twenty to thirty vehicles in view; true boxes included. Time is
that of the processor, summed over all threads: on an idle machine the clock shows no more. The
best of a few passes counts: the others measure what else the machine does.
"""

from __future__ import annotations

import json
import sys
import time

from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.rendered_scene import RenderedScene, render_scene
from geoorbit_ros.scenes.scene import load_scene

SCENE, SIZE, FPS, SEED = "straight_3x3", (1280, 720), 25.0, 3
PASSES, FRAMES, LIMIT = 8, 20, 1.0
WEATHER = {
    "day": Conditions(),
    "dusk": Conditions(light="dusk"),
    "night": Conditions(light="night"),
    "night, rain": Conditions(light="night", rain=True),
}


def frame_s(rendered: RenderedScene) -> tuple[float, float]:
    """Processor seconds per frame in the fastest pass, and boxes per frame in all."""
    next(rendered)  # warm
    times, boxes = [], 0
    for _ in range(PASSES):
        start = time.process_time()
        boxes += sum(len(next(rendered).boxes) for _ in range(FRAMES))
        times.append((time.process_time() - start) / FRAMES)
    return min(times), boxes / (PASSES * FRAMES)


def main() -> None:
    for name, conditions in WEATHER.items():
        duration_s = (PASSES * FRAMES + 2) / FPS
        rendered = render_scene(load_scene(SCENE), duration_s, SEED, conditions, FPS, SIZE)
        seconds, boxes = frame_s(rendered)
        ratio = round(seconds * FPS, 4)
        title = f"rendered frame, {name} / frame period at 25 fps"
        print(json.dumps({"name": title, "ratio": ratio, "limit": LIMIT}), flush=True)
        print(f"{title}: {1e3 * seconds:.1f} ms, {boxes:.0f} vehicles in view", file=sys.stderr)


if __name__ == "__main__":
    main()
