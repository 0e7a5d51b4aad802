"""Trains f of L_center on sets of lanes drawn at random; no camera's data take part.

Run by hand only, when the embedding is to change; nothing in the package imports it.
`python -m geoorbit_ros.learning.embedding_training FILE` writes the weights that the package ships.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from geoorbit_ros.learning.lane_embedding import FEATURES, HIDDEN, LAYERS, POINTS, network_input

Array = NDArray[np.float64]

SAMPLES = 64
"""Points of a drawn lane. Chosen: more take time, fewer blur its ends."""
BATCH = 256
"""Triplets of a step. Chosen: more take time, fewer make the steps noisier."""
STEPS = 4000
"""Chosen: more take time, fewer end before the loss has settled."""
MARGIN = 1.0
"""Squared distance of neighbouring lanes: the unit of L_center, one lane spacing."""
DECIMALS = 5
"""Digits of the weights in the file. Chosen: more make it longer, fewer change the features."""


class Network(nn.Module):
    """The trainable twin of `LaneEmbeddingNet`."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden = nn.Linear(2 * POINTS, HIDDEN)
        self.output = nn.Linear(HIDDEN, FEATURES)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, FEATURES) features of (B, 2 * POINTS) inputs."""
        features: torch.Tensor = self.output(torch.relu(self.hidden(x)))
        return features


def random_triplets(random: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Anchors, positives and negatives, (count, SAMPLES, 2) each, in the road frame.

    A road is an arc of 40 to 200 m, radius 150 m or more, with lanes 3 to 3.8 m apart. A positive
    is the anchor with its ends cut or prolonged by up to 30 % of its length and 0.3 m of lateral
    error; a negative is a lane one to four places beside it, cut alike, at times running the other
    way or off the road altogether (up to 60 m, any heading).
    """
    length = random.uniform(40.0, 200.0, count)
    curvature = random.uniform(-1 / 150, 1 / 150, count) * random.uniform(size=count)
    spacing = random.uniform(3.0, 3.8, count)
    lane = random.integers(-4, 5, count)
    sense = random.choice([-1.0, 1.0], count)
    anchor = _lane(length, curvature, lane * spacing, np.zeros((count, 2)), sense)
    cuts = random.uniform(-0.3, 0.3, (2, count, 2)) * length[:, None]
    error = 0.3 * random.standard_normal((2, count))
    positive = _lane(length, curvature, lane * spacing + error[0], cuts[0], sense)
    places = random.integers(1, 5, count) * random.choice([-1, 1], count)
    other = np.where(random.uniform(size=count) < 0.2, -sense, sense)
    offset = (lane + places) * spacing + error[1]
    negative = _lane(length, curvature, offset, cuts[1], other)
    lost = random.uniform(size=count) < 0.2
    angle = np.where(lost, random.uniform(-np.pi, np.pi, count), 0.0)
    shift = lost[:, None] * random.uniform(-60.0, 60.0, (count, 2))
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1)
    negative = np.einsum("bij,bsj->bsi", turn.reshape(-1, 2, 2), negative) + shift[:, None, :]
    return anchor, positive, negative


def _lane(length: Array, curvature: Array, offset: Array, cut: Array, sense: Array) -> Array:
    """Parallel arcs: `cut` metres are taken from their two ends, `sense` -1 reverses them."""
    share = np.linspace(0.0, 1.0, SAMPLES)[None, :]
    start, end = -0.5 * length + cut[:, 0], 0.5 * length - cut[:, 1]
    s = start[:, None] + share * (end - start)[:, None]
    s = np.where(sense[:, None] > 0.0, s, s[:, ::-1])
    heading = curvature[:, None] * s
    # sin(k s) / k and (1 - cos(k s)) / k, exact also where k is 0.
    along = s * np.sinc(heading / np.pi)
    across = 0.5 * s * heading * np.sinc(0.5 * heading / np.pi) ** 2
    d = offset[:, None]
    return np.stack([along - d * np.sin(heading), across + d * np.cos(heading)], axis=2)


def train(seed: int = 0, steps: int = STEPS) -> dict[str, Array]:
    """Weights by name, from triplet margin loss on squared distances (with a margin).

    Without a margin f = 0 would be a perfect solution. The scale is set afterwards: the mean
    squared distance of lanes next to each other is 1.
    """
    torch.manual_seed(seed)
    random = np.random.default_rng([seed, 11])
    network = Network()
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        anchor, positive, negative = (
            network(torch.tensor(network_input(x), dtype=torch.float32))
            for x in random_triplets(random, BATCH)
        )
        near = (anchor - positive).square().sum(1)
        far = (anchor - negative).square().sum(1)
        loss = torch.relu(near - far + MARGIN).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    weights = {
        name: value.detach().numpy().astype(np.float64)
        for name, value in network.state_dict().items()
    }
    scale = 1.0 / np.sqrt(_neighbour_distance(network, random))
    for name in ("output.weight", "output.bias"):
        weights[name] = scale * weights[name]
    return {name: np.round(weights[name], DECIMALS) for name in LAYERS}


def _neighbour_distance(network: Network, random: np.random.Generator) -> float:
    """Mean squared distance between the features of lanes next to each other."""
    count = 4096
    length = random.uniform(40.0, 200.0, count)
    curvature = random.uniform(-1 / 150, 1 / 150, count) * random.uniform(size=count)
    offset = random.uniform(-15.0, 15.0, count)
    pair = [
        _lane(length, curvature, offset + aside, np.zeros((count, 2)), np.ones(count))
        for aside in (0.0, 3.5)
    ]
    with torch.no_grad():
        a, b = (network(torch.tensor(network_input(x), dtype=torch.float32)) for x in pair)
    return float((a - b).square().sum(1).mean())


def main() -> None:
    """Write the weights to the file named on the command line."""
    torch.set_num_threads(1)
    content = {name: value.tolist() for name, value in train().items()}
    Path(sys.argv[1]).write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
