"""Times Flower's FedAvg on arrays from a file; run by Python of an environment with `flwr`.

python flower_fedavg.py ARRAYS.npz REPEATS    prints {"seconds": [...], "memory_mb": ...}
"""

# mypy: disable-error-code="import-not-found"
from __future__ import annotations

import json
import logging
import resource
import sys
import time

import numpy as np
from flwr.app import ArrayRecord, Message, MetricRecord, RecordDict
from flwr.serverapp.strategy import FedAvg
from flwr.supercore.task_identity import TaskIdentity


def main() -> None:
    logging.disable(logging.CRITICAL)
    # What Flower's own server sets before its app runs.
    TaskIdentity.run_id = TaskIdentity.node_id = TaskIdentity.task_id = 1
    with np.load(sys.argv[1]) as file:
        shapes, updates, counts = json.loads(str(file["shapes"])), file["updates"], file["counts"]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    replies = []
    for row, count in zip(updates, counts.tolist(), strict=True):
        parts = np.split(row, ends)
        arrays = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        content = RecordDict(
            {
                "arrays": ArrayRecord(numpy_ndarrays=arrays),
                "metrics": MetricRecord({"num-examples": count, "loss": 0.5}),
            }
        )
        replies.append(Message(content, dst_node_id=1, message_type="train"))
    seconds = []
    for _ in range(int(sys.argv[2])):
        start = time.process_time()
        mean, _ = FedAvg().aggregate_train(1, replies)
        seconds.append(time.process_time() - start)
    mean = np.concatenate([array.ravel() for array in mean.to_numpy_ndarrays()])
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": seconds, "memory_mb": memory_mb, "mean": mean.tolist()}))


if __name__ == "__main__":
    main()
