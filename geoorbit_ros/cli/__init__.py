"""The `geoorbit` command."""

import os
import signal
import sys

_as_module = sys.argv[:1] == ["-m"] and any(w.startswith(f"{__name__}.") for w in sys.orig_argv)
if _as_module or "".join(sys.argv[:1]).rpartition("/")[2] == "geoorbit":
    # The command is starting. Until `main` handles signals, a Ctrl-C or SIGTERM ends the process
    # without a word: there is nothing to put in order yet.
    for _number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(_number) is not signal.SIG_IGN:
            signal.signal(_number, lambda *_: os._exit(130))
