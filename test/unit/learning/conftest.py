"""The small synthetic traffic of the lane tests is used here, too."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "lanes"))
