"""One camera of a federation: a real meta_client, with a made-up observation and made-up lessons.

camera_host.py NAME KEY_FILE SERVER_KEY FOLDER [ENCODING]    ends with 0 once training is over

It keeps its state in FOLDER/NAME.npz and writes the round to FOLDER/NAME.learning when it begins to
train or validate for it. Where there is a FOLDER/NAME.go, it ends that only once the number in it
is as high.
"""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

sys.path.insert(0, str(Path(__file__).parents[1]))

from made_up_lanes import made_up_reference, made_up_tracks

from geoorbit_ros.federated.payloads.model_layout import Tensors
from geoorbit_ros.federated.rounds.client import LocalResult, TrainingOrder
from geoorbit_ros.learning import camera_session
from geoorbit_ros.learning.camera_session import LearningResult
from geoorbit_ros.nodes.meta_client import MetaClientNode
from geoorbit_ros.nodes.support.process import make_executor

LIMIT_S = 200.0


def lesson(camera_id: str, tensors: Tensors, order: TrainingOrder) -> LocalResult:
    """Deterministic local training that depends on camera, round and model."""
    gain = -0.1 * (len(camera_id) + order.round)
    if not order.train:
        return LocalResult({}, 0, 1.0 / order.round, gain)
    generator = np.random.default_rng([order.round, *camera_id.encode()])
    delta = {
        name: (0.1 * generator.normal(size=value.shape) - 0.2 * value).astype(np.float32)
        for name, value in tensors.items()
    }
    return LocalResult(delta, 1 + len(camera_id), 1.0 / order.round, gain)


def main() -> int:
    name, key_file, server_key, place, *encoding = sys.argv[1:]
    folder = Path(place)

    def learned(task: Any, _: str, tensors: Any, order: Any, _best: Any = None) -> LearningResult:
        (folder / f"{name}.learning").write_text(str(order.round))
        deadline, go = time.monotonic() + LIMIT_S, folder / f"{name}.go"
        while go.exists() and int(go.read_text() or 0) < order.round:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{go} stays below {order.round}")
            time.sleep(0.05)
        return LearningResult(lesson(task.camera_id, tensors, order), np.zeros(3))

    setattr(camera_session, "learn_from_camera", learned)  # noqa: B010
    rclpy.init()
    parameters = {
        "key_file": key_file,
        "server_key": server_key,
        "observation_s": 1.0,
        "state_file": str(folder / f"{name}.npz"),
        "encoding": encoding[0] if encoding else "float32",
    }
    node = MetaClientNode(namespace=name, overrides=parameters)
    node.session._executor = ThreadPoolExecutor(1)
    node.session.refer(made_up_reference(), -10.0)
    for stamp_ns, rows in made_up_tracks(1.0):
        node.session.add(stamp_ns, rows)
    executor = make_executor()
    executor.add_node(node)
    deadline = time.monotonic() + LIMIT_S
    while not node.client.finished and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.2)
    finished = node.client.finished
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0 if finished else 1


if __name__ == "__main__":
    sys.exit(main())
