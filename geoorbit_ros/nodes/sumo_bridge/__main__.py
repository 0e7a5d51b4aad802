"""`python -m geoorbit_ros.nodes.sumo_bridge`, as of every other node."""

import sys

from geoorbit_ros.nodes.sumo_bridge.node import main

if __name__ == "__main__":
    sys.exit(main())
