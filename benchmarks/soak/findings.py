"""Samples as figures, table and drawing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from soak.processes import Slope, slope
from soak.watch import Samples


def figures(samples: Samples, minutes: float, warm_min: float) -> dict[str, Any]:
    """All figures after the warm-up, fit for JSON."""
    minute = np.array(samples.minute)
    warm = minute > warm_min
    names = sorted(samples.memory_mb[-1])

    def series(table: list[dict[str, float]], name: str) -> Any:
        return np.array([row.get(name, 0.0) for row in table])

    processes = {}
    span_s = 60.0 * float(minute[warm][-1] - minute[warm][0])
    for name in names:
        memory, cpu_s = series(samples.memory_mb, name)[warm], series(samples.cpu_s, name)[warm]
        processes[name] = memory_figures(slope(minute[warm], memory), memory) | {
            "cores": float(cpu_s[-1] - cpu_s[0]) / span_s
        }
    total = np.sum([series(samples.memory_mb, name) for name in names], axis=0)[warm]
    cameras = {}
    for camera in sorted({camera for camera, _ in samples.latency_s}):
        lost = series(samples.lost, camera)[warm]
        cameras[camera] = {"lost": float(lost[-1] - lost[0])} | {
            topic: latency_figures(samples.after(warm_min, camera, topic))
            for topic in ("tracks", "lanes")
        }
    return {
        "minutes": minutes,
        "warm_up_minutes": warm_min,
        "processes": processes,
        "all": memory_figures(slope(minute[warm], total), total)
        | {"cores": sum(p["cores"] for p in processes.values())},
        "cameras": cameras,
        "problems_at_the_end": samples.problems,
    }


def memory_figures(line: Slope, memory: Any) -> dict[str, float]:
    """Memory at either end, and its slope."""
    return {
        "memory_mb_first": float(memory[0]),
        "memory_mb_last": float(memory[-1]),
        "slope_mb_per_min": line.per_minute,
        "slope_error": line.error,
        "slope_over_noise": line.in_noise,
    }


def latency_figures(heard: Any) -> dict[str, float]:
    """Median, 99 % and worst, and how much the last quarter is later than the first: a backlog."""
    if len(heard) < 8:
        return {"messages": len(heard)}
    late_ms, quarter = 1e3 * heard[:, 1], len(heard) // 4
    return {
        "messages": len(heard),
        "median_ms": float(np.median(late_ms)),
        "p99_ms": float(np.quantile(late_ms, 0.99)),
        "max_ms": float(late_ms.max()),
        "drift_ms": float(np.median(late_ms[-quarter:]) - np.median(late_ms[:quarter])),
    }


def print_tables(kind: str, found: dict[str, Any]) -> None:
    """For people, on standard error."""
    console = Console(stderr=True, width=120)
    table = Table("process", "MB first", "MB last", "MB/min ± 1σ", "cores", title=f"Fleet: {kind}")
    for name, p in [*found["processes"].items(), ("all", found["all"])]:
        line = f"{p['slope_mb_per_min']:+.2f} ± {p['slope_error']:.2f}"
        memory = (f"{p['memory_mb_first']:.0f}", f"{p['memory_mb_last']:.0f}")
        table.add_row(name, *memory, line, f"{p['cores']:.2f}")
    console.print(table)
    table = Table(
        "camera", "frames", "lost", "tracks ms: 50 %", "99 %", "max", "drift", "lanes 99 %"
    )
    for name, c in found["cameras"].items():
        keys = ("median_ms", "p99_ms", "max_ms", "drift_ms")
        late = [f"{c['tracks'].get(key, np.nan):.0f}" for key in keys]
        lanes = f"{c['lanes'].get('p99_ms', np.nan):.0f}"
        table.add_row(name, f"{c['tracks']['messages']}", f"{c['lost']:g}", *late, lanes)
    console.print(table)
    console.print("not healthy at the end:", "; ".join(found["problems_at_the_end"]) or "nothing")


def write_memory(samples: Samples, file: Path) -> None:
    """Resident megabytes over the minutes, a column per process."""
    names = sorted(samples.memory_mb[-1])
    lines = [",".join(["minute", *names])]
    for minute, row in zip(samples.minute, samples.memory_mb, strict=True):
        lines.append(
            ",".join([f"{minute:.3f}", *(f"{row.get(name, np.nan):.3f}" for name in names)])
        )
    file.write_text("\n".join(lines) + "\n")


def draw(samples: Samples, warm_min: float, title: str, file: Path) -> None:
    """Memory of every process, and the latency of every camera's tracks, over the minutes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (memory, late) = plt.subplots(2, 1, figsize=(9, 6.5), sharex=True, layout="constrained")
    for name in sorted(samples.memory_mb[-1]):
        memory.plot(
            samples.minute, [row.get(name, np.nan) for row in samples.memory_mb], label=name
        )
    memory.set(ylabel="resident memory, MB", title=title, ylim=(0, None))
    for (camera, topic), heard in sorted(samples.latency_s.items()):
        if topic != "tracks" or not heard:
            continue
        minute, late_s = np.array(heard).T
        edges = np.arange(0.0, minute[-1] + 0.25, 0.25)
        place = np.digitize(minute, edges)
        worst = [1e3 * np.quantile(late_s[place == k], 0.99) for k in np.unique(place)]
        late.plot(edges[np.unique(place) - 1], worst, label=camera)
    late.set(xlabel="minutes", ylabel="stamp to tracks, 99 % of 15 s, ms", ylim=(0, None))
    for axes in (memory, late):
        axes.axvspan(0.0, warm_min, color="0.92", zorder=0)
        axes.legend(fontsize=7, ncols=2, loc="upper right")
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=110)
    plt.close(figure)
