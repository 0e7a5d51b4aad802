"""Keys of a fleet's federation, made once and kept in its output folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from geoorbit_ros.federated.keys import Signer, read_private_key, write_private_key
from geoorbit_ros.storage.atomic import atomic_output

SERVER_KEY, ROSTER = "server.key", "roster.txt"


@dataclass(frozen=True, slots=True)
class FederationKeys:
    """Where the keys are, and the public ones.

    Attributes:
        folder: Holds `server.key`, `<camera>.key` and `roster.txt`.
        server: Public key in hex digits.
        cameras: The same by camera id.
    """

    folder: Path
    server: str
    cameras: dict[str, str]


def federation_keys(folder: Path, camera_ids: Sequence[str]) -> FederationKeys:
    """Read the keys of server and cameras, make those that are missing, and write the roster.

    Raises:
        FederationError: A key file that is broken or can't be written.
    """
    server = _public(folder / SERVER_KEY)
    cameras = {name: _public(folder / f"{name}.key") for name in camera_ids}
    with atomic_output(folder / ROSTER) as path:
        lines = (f"{name} {key}\n" for name, key in cameras.items())
        path.write_text("".join(lines), encoding="utf-8")
    return FederationKeys(folder, server, cameras)


def _public(file: Path) -> str:
    if not file.exists():
        return write_private_key(file).hex()
    public = Signer(read_private_key(file), "").public
    assert public is not None  # it was made from a key
    return public.hex()
