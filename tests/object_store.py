"""An S3 that speaks HTTP, for what reads and writes runs on an object store."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import boto3
import pytest

from benchmarks.faults.s3_server import CREDENTIALS, Application, s3_server, uri_of

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
    with s3_server(around) as place, pytest.MonkeyPatch.context() as patch:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        boto3.client("s3", endpoint_url=f"http://{place}", region_name="us-east-1").create_bucket(Bucket=bucket)
        yield uri_of(place, f"{bucket}/run")
