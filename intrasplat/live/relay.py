"""One RTSP connection, offered at a port of this machine, to which alone the reading process may connect.

It adds TLS where the server wants it, and ends at a redirect: FFmpeg would follow one to any host.
"""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import threading

MAX_PIECE_BYTES = 1 << 16
WAIT_S = 0.5
REDIRECT = b"RTSP/1.0 3"


class Relay:
    """Copies bytes between the server and the one process that connects to `port`.

    redirected  whether the server answered with a redirect
    """

    def __init__(self, server: socket.socket) -> None:
        self._server = server
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=1)
        self.port = int(self._listener.getsockname()[1])
        self.redirected = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="rtsp-relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the connection."""
        self._closed = True
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._thread.join(2 * WAIT_S)

    def _run(self) -> None:
        try:
            with self._server, contextlib.suppress(OSError), self._accepted() as reader:
                self._copy(reader)
        finally:
            self._listener.close()

    def _accepted(self) -> socket.socket:
        while not self._closed:
            if select.select([self._listener], [], [], WAIT_S)[0]:
                reader = self._listener.accept()[0]
                self._listener.close()
                return reader
        raise ConnectionAbortedError

    def _copy(self, reader: socket.socket) -> None:
        seen = b""
        while not self._closed:
            waiting = isinstance(self._server, ssl.SSLSocket) and self._server.pending() > 0
            ready = [self._server] if waiting else select.select([self._server, reader], [], [], WAIT_S)[0]
            for source in ready:
                piece = source.recv(MAX_PIECE_BYTES)
                if not piece:
                    return
                if source is reader:
                    self._server.sendall(piece)
                    continue
                seen = seen[-len(REDIRECT) :] + piece
                if REDIRECT in seen:
                    self.redirected = True
                    return
                reader.sendall(piece)
