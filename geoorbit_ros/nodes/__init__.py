"""ROS 2 nodes. One file per node; a node of several files is a folder."""

import os
import signal
import sys

if sys.argv[:1] == ["-m"] and any(word.startswith(f"{__name__}.") for word in sys.orig_argv):
    # `python -m geoorbit_ros.nodes.NODE` is starting. Until the node handles signals itself, a
    # Ctrl-C or SIGTERM ends the process without a word: there is nothing to put in order yet.
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, lambda *_: os._exit(0))
