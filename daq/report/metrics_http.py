"""The web server of the metrics. The number of open connections is limited, also for clients that send no request:
each is an open file and a thread, which the log and the links need too."""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app

MAX_CONNECTIONS = 16  # connections at a time; for one more the oldest is ended
SILENT_S = 10.0


class _Handler(WSGIRequestHandler):
    timeout = SILENT_S

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, because the standard streams are for the operator."""


class FewAtATime(ThreadingMixIn, WSGIServer):
    """Serves each connection in a thread, at most MAX_CONNECTIONS at a time."""

    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._connections: list[socket.socket] = []
        self._changed = threading.Condition()
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._changed:
            while len(self._connections) >= MAX_CONNECTIONS:
                with contextlib.suppress(OSError):
                    self._connections[0].shutdown(socket.SHUT_RDWR)  # which ends its thread
                self._changed.wait()
            self._connections.append(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        super().shutdown_request(request)
        with self._changed:
            if request in self._connections:
                self._connections.remove(request)
                self._changed.notify_all()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report nothing when a client goes away."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def serve(registry: CollectorRegistry, port: int, host: str) -> tuple[WSGIServer, threading.Thread]:
    """Start the server; it runs until its `shutdown`. Raises OSError, and OverflowError for a port that is none."""
    server = make_server(host, port, make_wsgi_app(registry), FewAtATime, handler_class=_Handler)
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    return server, thread
