"""Train the vehicle network on folders of labelled films and images (`training_images.py`).

    python benchmarks/train_detector.py FOLDER… --out vehicles.onnx [--minutes 60] [--threads 1]
        [--resume vehicles.pt]

Writes `vehicles.onnx`, and beside it `vehicles.pt` from which `--resume` goes on. Films weigh the
same whatever their length; a folder `NAME=3` weighs three times as much per film.
"""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from geoorbit_ros.cli.console import console
from training_images import Example, batch, read_examples
from vehicle_network import VehicleNetwork, write_onnx

BATCH = 24
RATE = 2.5e-3
"""Largest learning rate of AdamW (Loshchilov and Hutter 2019)."""
DECAY = 0.02
KEPT_AVERAGE = 0.997
"""The weights that are written are a running mean of the trained ones, with this share kept."""
WARM_STEPS = 100
SIDES_WEIGHT, CLASS_WEIGHT = 1.0, 0.15
IMAGES_WEIGHT = 12.0
"""A folder of single images weighs as much as so many films."""
REPORT_S = 30.0


def loss(found: Tensor, heat: Tensor, sides: Tensor, kind: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Focal loss of the middles (Law and Deng 2018), GIoU of boxes, cross entropy of classes."""
    logit, wanted, counts = found[:, 0], heat[:, 0], heat[:, 1]
    score = torch.sigmoid(logit).clamp(1e-5, 1 - 1e-5)
    middle = wanted > 0.999
    right = -((1 - score) ** 2) * torch.log(score) * middle
    wrong = -((1 - wanted) ** 4) * score**2 * torch.log(1 - score) * ~middle
    middles = ((right + wrong) * counts).sum() / middle.sum().clamp(min=1)
    weight = sides[:, 4]
    here = weight > 0
    box, true = torch.exp(found[:, 1:5].clamp(-3, 6)), sides[:, :4]
    shared = torch.minimum(box, true)
    around = torch.maximum(box, true)
    inner = (shared[:, 0] + shared[:, 2]) * (shared[:, 1] + shared[:, 3])
    hull = (around[:, 0] + around[:, 2]) * (around[:, 1] + around[:, 3])
    union = (box[:, 0] + box[:, 2]) * (box[:, 1] + box[:, 3]) - inner
    union = union + (true[:, 0] + true[:, 2]) * (true[:, 1] + true[:, 3])
    giou = inner / union.clamp(min=1e-6) - (hull - union) / hull.clamp(min=1e-6)
    total = weight.sum().clamp(min=1e-6)
    boxes = ((1 - giou) * weight * here).sum() / total
    known = kind >= 0
    logits = found[:, 5:].permute(0, 2, 3, 1)[known]
    classes = functional.cross_entropy(logits, kind[known].long()) if len(logits) else boxes * 0
    return middles, boxes, classes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", help="FOLDER or FOLDER=WEIGHT")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="in all; the learning rate ends at 0"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    films: list[list[Example]] = []
    weights: list[float] = []
    for name in options.folders:
        folder, _, weight = name.partition("=")
        for film in read_examples(Path(folder)):
            films.append(film)
            of_film = IMAGES_WEIGHT if film[0].road is None else 1.0
            weights.append(of_film * float(weight or 1))
        console.print(f"{folder}: {len(films)} films so far, {sum(map(len, films))} images")
    train(films, np.array(weights) / np.sum(weights), options)


def train(films: list[list[Example]], weights: np.ndarray, options: argparse.Namespace) -> None:
    random = np.random.default_rng(options.seed)
    network = VehicleNetwork()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    step, spent_s = 0, 0.0
    average = copy.deepcopy(network).eval()
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    if options.resume:
        state = torch.load(options.resume, weights_only=False)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimiser.load_state_dict(state["optimiser"])
        step, spent_s = state["step"], state["spent_s"]
    whole_s = 60.0 * options.minutes
    start_s = told_s = time.monotonic() - spent_s
    means = np.zeros(3)
    first = step
    while (spent_s := time.monotonic() - start_s) < whole_s:
        warm = min((step + 1) / WARM_STEPS, 1.0)
        rate = RATE * warm * 0.5 * (1 + np.cos(np.pi * spent_s / whole_s))
        for group in optimiser.param_groups:
            group["lr"] = float(rate) + 1e-6
        images, *wanted = (torch.from_numpy(p) for p in batch(films, weights, BATCH, random))
        values = images.permute(0, 3, 1, 2).to(torch.float32) / 255.0
        network.train()
        with torch.autocast("cpu", torch.bfloat16):
            found = network(values)
        parts = loss(found.float(), *wanted)
        total = parts[0] + SIDES_WEIGHT * parts[1] + CLASS_WEIGHT * parts[2]
        optimiser.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        step += 1
        kept = min(KEPT_AVERAGE, step / (step + 20))
        with torch.no_grad():
            for mean, now in zip(
                average.state_dict().values(), network.state_dict().values(), strict=True
            ):
                if mean.dtype.is_floating_point:
                    mean.lerp_(now, 1 - kept)
                else:
                    mean.copy_(now)
        share = 1 / min(step, 50)
        means += share * (np.array([float(part.detach()) for part in parts]) - means)
        if time.monotonic() - told_s > REPORT_S:
            speed = (step - first) * BATCH / (time.monotonic() - told_s)
            told_s, first = time.monotonic(), step
            console.print(
                f"{step} steps, {speed:.0f} images/s: middles {means[0]:.3f}, "
                f"boxes {means[1]:.3f}, classes {means[2]:.3f}"
            )
            _save(network, average, optimiser, (step, spent_s), options.out)
    _save(network, average, optimiser, (step, spent_s), options.out)
    write_onnx(average, options.out)


def _save(
    network: VehicleNetwork,
    average: VehicleNetwork,
    optimiser: torch.optim.Optimizer,
    done: tuple[int, float],
    out: Path,
) -> None:
    state = {
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimiser": optimiser.state_dict(),
        "step": done[0],
        "spent_s": done[1],
    }
    torch.save(state, out.with_suffix(".part"))
    out.with_suffix(".part").replace(out.with_suffix(".pt"))


if __name__ == "__main__":
    main()
