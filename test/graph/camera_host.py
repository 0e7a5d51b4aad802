"""One camera of a federation, alone on its host: a real meta_client with a made-up observation.

camera_host.py NAME KEY_FILE SERVER_KEY    ends with status 0 once training is over
"""

import sys
import time
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

sys.path.insert(0, str(Path(__file__).parents[1]))

from made_up_lanes import made_up_reference, made_up_tracks

from geoorbit_ros.federated import camera_session
from geoorbit_ros.federated.camera_learning import Lesson
from geoorbit_ros.federated.client import LocalResult
from geoorbit_ros.nodes.meta_client import MetaClientNode
from geoorbit_ros.nodes.process import make_executor

LIMIT_S = 100.0


class AtOnce(Executor):
    """Runs where it is told to."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def learned(task: Any, estimator: str, tensors: Any, order: Any, best: Any = None) -> Lesson:
    """Local training that moves every head's bias, without any search for theta*."""
    delta = {name: np.zeros_like(value) for name, value in tensors.items()}
    delta["heads.bias"] += np.float32(0.1)
    return Lesson(LocalResult(delta, 1, 1.0), np.zeros(3))


def main() -> int:
    name, key_file, server_key = sys.argv[1:]
    camera_session.learn_from_camera = learned
    rclpy.init()
    parameters = {"key_file": key_file, "server_key": server_key, "observation_s": 1.0}
    node = MetaClientNode(namespace=name, overrides=parameters)
    node.session._executor = AtOnce()
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
