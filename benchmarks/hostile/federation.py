"""Attacks on learning together."""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import ByteMultiArray

from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.keys import Roster, Signer, read_private_key, write_private_key
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.local_work import LocalResult
from hostile.harness import Attacker, Finding, Victim, victims, wait

RELIABLE = QoSProfile(
    depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
MODELS = QoSProfile(
    depth=50,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
RUBBISH = bytes((0, 1, 0, 0)) + bytes(8) + (10_000_000).to_bytes(4, "little") + b"Z" * 10_000_000


class Cameras:
    """Two honest clients, whose updates are ones, and what they hear."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("server", "north", "south"):
            if not (folder / f"{name}.key").exists():
                write_private_key(folder / f"{name}.key")
        server = Signer(read_private_key(folder / "server.key"), "geoorbit").public
        self.clients = []
        lines = []
        for name in ("north", "south"):
            signer = Signer(read_private_key(folder / f"{name}.key"), "geoorbit")
            assert signer.public is not None
            lines.append(f"{name} {signer.public.hex()}\n")
            self.clients.append(
                FederatedClient(name, self._train, signer=signer, server_key=server)
            )
        (folder / "roster.txt").write_text("".join(lines))
        self.refused: list[str] = []
        self.updates: list[bytes] = []

    @staticmethod
    def _train(tensors: dict[str, np.ndarray], _: object) -> LocalResult:
        delta = {name: np.full_like(value, 0.01) for name, value in tensors.items()}
        return LocalResult(delta, 1, 0.5, float("nan"))

    def server(self, make: Callable[..., Victim], **more: object) -> Victim:
        """A server for them."""
        folder = self.folder
        given: dict[str, object] = {
            "roster": folder / "roster.txt",
            "key_file": folder / "server.key",
            "checkpoint": folder / "checkpoint" / "server.npz",
            "validate_every": 0,
            "rounds": 20,
        }
        return make("federated_server", folder, **(given | more))

    def listen(self, attacker: Attacker) -> None:
        """Let them answer what they hear."""

        def take(message: ByteMultiArray) -> None:
            payload = b"".join(message.data)
            for client in self.clients:
                try:
                    update = client.answer(payload)
                except Exception as error:
                    self.refused.append(str(error))
                else:
                    self.updates += [update] if update else []

        attacker.node.create_subscription(ByteMultiArray, "/federated/global_model", take, MODELS)


def message(payload: bytes) -> ByteMultiArray:
    return ByteMultiArray(data=[bytes((value,)) for value in payload])


def full_disk(folder: Path) -> Finding:
    """Rows 5 and 6: no room as the round closes, for as long as three tries, then room again."""
    cameras = Cameras(folder)
    with victims() as make:
        attacker = Attacker()
        server = cameras.server(make)
        cameras.listen(attacker)
        publisher = attacker.publisher(ByteMultiArray, "/federated/client_update", RELIABLE)
        wait(lambda: len(cameras.updates) == 2, attacker)
        before = cameras.clients[0].tensors
        server.fill_disk(True)
        for update in cameras.updates[:2]:
            publisher.publish(message(update))
        wait(lambda: not server.alive, attacker, 12.0)
        alive = server.alive
        if alive:
            server.fill_disk(False)
            wait(lambda: cameras.clients[0].model_of[1] == 2, attacker, 15.0)
        after = cameras.clients[0].tensors
        attacker.close()
    if not alive:
        return Finding("5, 6: full disk as a round closes", 1.0, "the server died")
    assert before is not None
    assert after is not None
    step = float(np.mean([np.mean(after[n] - before[n]) for n in after])) / 0.01
    moved = abs(step - 1.0) > 0.01
    told = "told in one sentence" if "Traceback" not in server.text else "a traceback"
    return Finding(
        "5, 6: full disk as a round closes",
        float(moved),
        f"updates applied {step:.3f} times, {told}",
    )


def rubbish(folder: Path) -> Finding:
    """Row 9: 100 messages of 10 MB."""
    cameras = Cameras(folder)
    with victims() as make:
        attacker = Attacker()
        server = cameras.server(make)
        publisher = attacker.publisher(ByteMultiArray, "/federated/client_update", RELIABLE)
        before = peak = server.resident_mb
        for _ in range(100):
            publisher.publish(RUBBISH)
            peak = max(peak, server.resident_mb if server.alive else 0.0)
        end_s = time.monotonic() + 15.0
        while time.monotonic() < end_s and server.alive:
            attacker.spin(0.2)
            peak = max(peak, server.resident_mb)
        after = server.resident_mb if server.alive else float("nan")
        attacker.close()
    what = f"{before:.0f} MB, {peak:.0f} at most, {after:.0f} afterwards"
    return Finding("9: rubbish, 1 GB", (after - before) / 1000, what)


def damaged_state(folder: Path) -> Finding:
    """Row 14: the state of a client is damaged."""
    cameras = Cameras(folder)
    (folder / "north.npz").write_bytes(b"PK damaged")
    with victims() as make:
        client = make(
            "meta_client",
            folder,
            "/north",
            key_file=cameras.folder / "north.key",
            state_file=folder / "north.npz",
        )
        wait(lambda: not client.alive or "damaged" in client.text, limit_s=15.0)
        alive, text = client.alive, client.text
    what = "it does not start" if not alive else "set aside, goes on"
    what += ", advises allow_pickle" if "allow_pickle" in text else ""
    return Finding("14: damaged state", float(not alive), what)


def unsigned_line(folder: Path) -> Finding:
    """Row 16: a key is missing in the roster; a camera has the server's key."""
    cameras = Cameras(folder)
    roster = folder / "roster.txt"
    roster.write_text(roster.read_text() + "east\n")
    damage = []
    try:
        Roster.read(roster)
        damage.append("a forgotten key admits anybody")
    except FederationError:
        pass
    public = Signer(read_private_key(folder / "server.key"), "geoorbit").public
    assert public is not None
    roster.write_text(f"north {public.hex()}\n")
    try:
        named = "server" in inspect.signature(Roster.read).parameters
        Roster.read(roster, public) if named else Roster.read(roster)
        damage.append("a camera with the server's key is admitted")
    except FederationError:
        pass
    del cameras
    return Finding("16: roster", len(damage) / 2, "; ".join(damage) or "both refused")


def lost_checkpoint(folder: Path) -> Finding:
    """Row 17: the checkpoint is lost and the clock is set back a year."""
    cameras = Cameras(folder)
    with victims() as make:
        attacker = Attacker()
        server = cameras.server(make)
        cameras.listen(attacker)
        wait(lambda: cameras.clients[0].model_of[1] == 1, attacker)
        known = cameras.clients[0].model_of[0]
        server.end()
        for file in (folder / "checkpoint").iterdir():
            file.unlink()
        (folder / "sitecustomize.py").write_text(
            "import time\n_now = time.time\ntime.time = lambda: _now() - 365 * 86400\n"
        )
        before = os.environ.get("PYTHONPATH", "")
        os.environ["PYTHONPATH"] = f"{folder}:{before}"
        try:
            cameras.server(make)
        finally:
            os.environ["PYTHONPATH"] = before
        followed = wait(lambda: cameras.clients[0].model_of[0] > known, attacker, 15.0)
        attacker.close()
    what = "clients follow" if followed else "clients refuse the server for ever"
    return Finding("17: checkpoint lost, clock set back", float(not followed), what)


ATTACKS = (full_disk, rubbish, damaged_state, unsigned_line, lost_checkpoint)
