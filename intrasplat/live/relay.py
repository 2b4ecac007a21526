"""One connection, relayed to the reading process: TLS ends here, and RTSP is offered at a port of this machine, the one
port to which that process may connect. It ends at a redirect of RTSP: FFmpeg would follow one to any host.
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
    """Copies bytes between the server and a reader.

    port        where the reader connects; 0 if it is connected already
    redirected  whether the server answered with a redirect of RTSP
    """

    def __init__(self, server: socket.socket, reader: socket.socket | None = None) -> None:
        """reader: our end of the reader's connection; None: the one process that connects to `port`."""
        self._server, self._reader = server, reader
        self._listener = None if reader is not None else socket.create_server(("127.0.0.1", 0), backlog=1)
        self.port = 0 if self._listener is None else int(self._listener.getsockname()[1])
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
        with self._server, contextlib.suppress(OSError), self._reader or self._accepted() as reader:
            self._copy(reader)

    def _accepted(self) -> socket.socket:
        assert self._listener is not None
        with self._listener:
            while not self._closed:
                if select.select([self._listener], [], [], WAIT_S)[0]:
                    return self._listener.accept()[0]
        raise ConnectionAbortedError

    def _copy(self, reader: socket.socket) -> None:
        seen = b""
        while not self._closed:
            waiting = isinstance(self._server, ssl.SSLSocket) and self._server.pending() > 0
            ready = [self._server] if waiting else select.select([self._server, reader], [], [], WAIT_S)[0]
            for source in ready:
                piece = _received(source)
                if piece is None:
                    continue
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


def _received(source: socket.socket) -> bytes | None:
    """Bytes that have come in; none at the end; None if TLS alone had something to say."""
    if not isinstance(source, ssl.SSLSocket):
        return source.recv(MAX_PIECE_BYTES)
    source.setblocking(False)
    try:
        return source.recv(MAX_PIECE_BYTES)
    except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
        return None
    finally:
        source.setblocking(True)
