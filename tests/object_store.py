"""An S3 that speaks HTTP, for what reads and writes runs on an object store."""

import itertools
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias
from urllib.parse import quote

import boto3
import pytest
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import make_server

Application: TypeAlias = Callable[[dict[str, Any], Any], Iterable[bytes]]
"""What answers a request (WSGI)."""

_numbers = itertools.count()


@contextmanager
def object_store(around: Callable[[Application], Application] = lambda application: application) -> Iterator[str]:
    """Serves an empty bucket; the credentials are in the environment meanwhile.

    Args:
        around: Stands between the server and the store.

    Yields:
        The URI of a run folder in it that is not there yet.
    """
    bucket = f"scenes-{next(_numbers)}"  # all stores of a process share their buckets
    server = make_server(
        "127.0.0.1",
        0,
        around(DomainDispatcherApplication(create_backend_app)),
        threaded=True,
        request_handler=MotoRequestHandler,
    )
    place = f"127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_ACCESS_KEY_ID", "test")
            patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
            patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
            boto3.client("s3", endpoint_url=f"http://{place}", region_name="us-east-1").create_bucket(Bucket=bucket)
            yield f"s3://{bucket}/run?region=us-east-1&scheme=http&endpoint_override={quote(place, safe='')}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
