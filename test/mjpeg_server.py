"""A network camera on this machine: MJPEG over HTTP that ends, stalls and comes back on command."""

from __future__ import annotations

import base64
import threading
from collections.abc import Iterable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self

import cv2
import numpy as np

STALL_LIMIT_S = 30.0


def grey_image(level: int, size: tuple[int, int] = (160, 120)) -> np.ndarray:
    """(H, W, 3) of one level, which JPEG keeps."""
    return np.full((size[1], size[0], 3), level, np.uint8)


class MjpegServer:
    """Serves one list of images per connection.

    The first connection is closed after its images, all others stay open without another one.

    Args:
        connections: Images of the first connection, of the second, …; later ones are refused.

    Attributes:
        address: To open with FFmpeg.
        opened: Connections so far.
        credentials: `user:password` that it asks for (RFC 7617); empty: none.
    """

    def __init__(self, *connections: Sequence[np.ndarray]) -> None:
        self.opened = 0
        self.credentials = ""
        self._connections = connections
        self._released = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.serve(self)

            def log_message(self, *_: object) -> None:
                """Stay silent."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/stream"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def serve(self, handler: BaseHTTPRequestHandler) -> None:
        given = handler.headers.get("Authorization", "").removeprefix("Basic ")
        if self.credentials and base64.b64decode(given).decode() != self.credentials:
            handler.send_response(401)
            handler.send_header("WWW-Authenticate", 'Basic realm="camera"')
            handler.send_header("Content-Length", "0")
            handler.end_headers()
            return
        self.opened += 1
        if self.opened > len(self._connections):
            handler.send_error(503)
            return
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        handler.end_headers()
        try:
            self._write(handler, self._connections[self.opened - 1])
            if self.opened > 1:
                self._released.wait(STALL_LIMIT_S)
        except OSError:
            return  # the client has gone

    def _write(self, handler: BaseHTTPRequestHandler, images: Iterable[np.ndarray]) -> None:
        for image in images:
            jpeg = cv2.imencode(".jpg", image)[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            handler.wfile.write(head.encode() + jpeg + b"\r\n")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._released.set()
        self._server.shutdown()
        self._server.server_close()
