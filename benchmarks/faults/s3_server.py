"""An S3 server on this machine (moto), whose objects are in its memory."""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias
from urllib.parse import quote

from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import make_server

Application: TypeAlias = Callable[[dict[str, Any], Any], Iterable[bytes]]
"""What answers a request (WSGI)."""

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_EC2_METADATA_DISABLED": "true"}
"""Environment variables of the clients."""


@contextmanager
def s3_server(around: Callable[[Application], Application] = lambda application: application) -> Iterator[str]:
    """Serves S3 in threads of this process. All servers of a process share their buckets.

    Args:
        around: Stands between the server and the store.

    Yields:
        ``host:port``.
    """
    logging.getLogger("werkzeug").setLevel(logging.WARNING)  # else a line for each request
    server = make_server(
        "127.0.0.1",
        0,
        around(DomainDispatcherApplication(create_backend_app)),
        threaded=True,
        request_handler=MotoRequestHandler,
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def uri_of(place: str, path: str) -> str:
    """Returns the URI of a path ``bucket/prefix`` on a server at ``host:port``."""
    return f"s3://{path}?region=us-east-1&scheme=http&endpoint_override={quote(place, safe='')}"
