"""The `geoorbit` command: how it begins and how it ends.

Whatever takes time to import is imported inside, so that a signal finds its handler in place.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from geoorbit_ros.cli.signals import EXIT_INTERRUPTED, Interruption

EXIT_BAD_INPUT = 2
"""As click reports wrong usage."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; what `geoorbit` on the command line calls.

    Args:
        arguments: Words after `geoorbit`; default: the process's.

    Returns:
        Exit code: 0 done, 1 a `--require` not met, 2 bad input (one sentence on standard error),
        130 after SIGINT or SIGTERM. Any other exception is a defect and keeps its traceback.
    """
    with Interruption(ends_process=arguments is None) as interruption:
        try:
            from geoorbit_ros.cli.app import app
            from geoorbit_ros.core.addresses import masked_text
            from geoorbit_ros.core.errors import GeoOrbitError, disk_fault

            try:
                app(args=None if arguments is None else list(arguments), prog_name="geoorbit")
            except GeoOrbitError as error:
                print(f"geoorbit: {masked_text(str(error))}", file=sys.stderr)
                return EXIT_BAD_INPUT
            except OSError as error:
                fault = disk_fault(error)
                if fault is None or interruption.came:
                    raise
                print(f"geoorbit: {masked_text(str(fault))}", file=sys.stderr)
                return EXIT_BAD_INPUT
            except SystemExit as end:
                return end.code if isinstance(end.code, int) else int(end.code is not None)
            return 0
        finally:
            interruption.over()
    return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
