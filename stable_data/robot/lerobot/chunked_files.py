"""The files of a LeRobotDataset: numbered, a thousand to a folder, and followed by another one when they are full."""

import io
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

CHUNK_FILES = 1000
"""Maximum number of files of a folder ``chunk-…``."""

FILE_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}"


class FileNumbers:
    """The number of a file, and of the folder that it is in; before :meth:`advance` there is none.

    Args:
        folder: Folder of the folders.
        ending: Ending of the files, such as ``.parquet``.
        chunk_files: Maximum number of files of a folder.

    Attributes:
        chunk: Number of the folder.
        file: Number of the file in it.
    """

    def __init__(self, folder: Path, ending: str, chunk_files: int) -> None:
        self._folder, self._ending, self._chunk_files = folder, ending, chunk_files
        self.chunk, self.file = 0, -1

    def advance(self) -> Path:
        """Goes to the next file and returns its path; its folder exists then."""
        self.file += 1
        if self.file == self._chunk_files:
            self.chunk, self.file = self.chunk + 1, 0
        path = self._folder / (FILE_NAME.format(chunk_index=self.chunk, file_index=self.file) + self._ending)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


class ParquetFiles:
    """Parquet files of one table, one after the other; what is written together is a row group of one file.

    Args:
        folder: Folder of their folders.
        schema: The columns.
        max_bytes: Size from which a file is followed by another one.
        chunk_files: Maximum number of files of a folder.

    Attributes:
        schema: The argument.
    """

    def __init__(self, folder: Path, schema: pa.Schema, max_bytes: int, chunk_files: int) -> None:
        self.schema = schema
        self._max_bytes, self._numbers = max_bytes, FileNumbers(folder, ".parquet", chunk_files)
        self._stream: io.BufferedWriter | None = None
        self._writer: pq.ParquetWriter | None = None
        self._is_empty = True
        # In dictionaries, pictures would be stored twice.
        self._with_dictionary = [column.name for column in schema if not pa.types.is_struct(column.type)]

    def start(self, num_bytes: int) -> tuple[int, int]:
        """Returns the numbers of the folder and of the file for the next rows.

        Args:
            num_bytes: Size of the rows.

        Raises:
            OSError: The folder cannot be written.
        """
        if self._stream is None or not (self._is_empty or self._stream.tell() + num_bytes <= self._max_bytes):
            self.close()
            self._stream = self._numbers.advance().open("wb")
            self._writer = pq.ParquetWriter(
                self._stream, self.schema, compression="snappy", use_dictionary=self._with_dictionary
            )
            self._is_empty = True
        return self._numbers.chunk, self._numbers.file

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Writes rows, at least one, and returns where they are, as :meth:`start`.

        Raises:
            OSError: The folder cannot be written.
        """
        place = self.start(table.nbytes)
        assert self._writer is not None
        self._writer.write_table(table, row_group_size=table.num_rows)
        self._is_empty = False
        return place

    def close(self) -> None:
        """Ends the file.

        Raises:
            OSError: The folder cannot be written.
        """
        if self._stream is not None and self._writer is not None:
            with self._stream:
                self._writer.close()
            self._stream = self._writer = None
