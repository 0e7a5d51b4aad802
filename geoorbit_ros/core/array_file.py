"""Files of arrays (`.npz`): bounded before anything is unpacked, whoever wrote them."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import UNREADABLE

MAX_ARRAY_BYTES = 1 << 30
"""All arrays of a file together. Chosen: ten times the largest that is written; a packed file of
a few kilobytes can stand for more than the memory has."""


def read_arrays(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name; objects of Python are none.

    Args:
        path: The file.
        expected: What it should be, for the error.

    Raises:
        FileNotFoundError: There is no such file.
        InputFileError: Not such a file, damaged, or one that unpacks to more than
            `MAX_ARRAY_BYTES`.
    """
    try:
        with zipfile.ZipFile(path) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > MAX_ARRAY_BYTES:
            found = f"arrays of {size} bytes"
            raise InputFileError(str(path), found, f"{expected} of {MAX_ARRAY_BYTES} at most")
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else ""
        found = reason or f"damage, or another kind of file ({type(error).__name__})"
        raise InputFileError(str(path), found, expected) from None
