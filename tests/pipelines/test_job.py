"""What the jobs share: whose fault an error is."""

import errno

import pytest

from pipelines.generate_answers import NOT_OF_A_SCENE
from pipelines.job import Rows, rows_or_failure
from pipelines.progress import Progress


class FailsOnce:
    """Rows whose first making fails as a disk or a network does."""

    calls = 0

    def __call__(self) -> Rows:
        self.calls += 1
        if self.calls == 1:
            raise OSError(errno.EIO, "Input/output error")
        return {"scenes": []}


def test_an_error_of_an_item_from_outside_is_its_row() -> None:
    (row,) = rows_or_failure("scene_1", Progress("read"), FailsOnce())["failures"]
    assert (row["id"], row["step"], row["code"]) == ("scene_1", "read", "unexpected")
    assert "Input/output error" in row["message"]


def test_an_error_that_is_the_runs_is_no_row_and_another_time_there_is_none() -> None:
    make = FailsOnce()
    with pytest.raises(OSError, match="Input/output error"):
        rows_or_failure("scene_1", Progress("read"), make, of_the_run=NOT_OF_A_SCENE)
    assert rows_or_failure("scene_1", Progress("read"), make, of_the_run=NOT_OF_A_SCENE) == {"scenes": []}
