"""Video files of pictures, written as the pictures come: by PyAV if it is installed, else by the program ffmpeg.

AV1 in the colour format yuv420p, a key frame every other picture: what LeRobot writes, so that single pictures are read fast.
"""

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError
from stable_data.robot.lerobot.chunked_files import FileNumbers

CODEC, PIXEL_FORMAT = "av1", "yuv420p"
_ENCODER = "libsvtav1"
_QUIET = ("SVT_LOG", "1")  # a variable of the environment: the encoder prints errors alone
_OPTIONS = {"g": "2", "crf": "30", "preset": "12"}


class VideoFile(Protocol):
    """A video file that is being written."""

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        """Adds a picture, (H, W, 3) uint8.

        Raises:
            ConfigError: The encoder refuses it (``video_failed``).
        """
        ...

    def close(self) -> None:
        """Ends the file.

        Raises:
            ConfigError: The encoder failed (``video_failed``).
        """
        ...

    def discard(self) -> None:
        """Gives the file up."""
        ...


def encoder_names() -> list[str]:
    """Returns the encoders that are installed, the preferred one first."""
    there = {"pyav": find_spec("av") is not None, "ffmpeg": shutil.which("ffmpeg") is not None}
    return [name for name, is_there in there.items() if is_there]


def check_encoder(size: tuple[int, int]) -> None:
    """Checks that videos can be written.

    Args:
        size: Height and width of the pictures, pixels.

    Raises:
        ConfigError: There is no encoder (``encoder_missing``), or the size is odd or too small (``video_size``).
    """
    if not encoder_names():
        raise ConfigError(
            "--video needs an encoder of videos, but neither PyAV nor the program ffmpeg is there; install one of them (pip install av, or "
            "apt install ffmpeg), or leave out --video",
            "encoder_missing",
        )
    if min(size) < 64 or size[0] % 2 or size[1] % 2:
        raise ConfigError(
            f"--video: pictures have {size[0]} x {size[1]} pixels, expected even numbers from 64 on; leave out --video",
            "video_size",
        )


def open_video(path: Path, fps: int, size: tuple[int, int]) -> VideoFile:
    """Starts a video file.

    Args:
        path: An mp4 file; its folder exists.
        fps: Pictures a second.
        size: Height and width of the pictures, pixels.
    """
    return (_PyAvFile if encoder_names()[0] == "pyav" else _FfmpegFile)(path, fps, size)


class _PyAvFile:
    """A file that PyAV writes."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        import av

        os.environ.setdefault(*_QUIET)
        self._av, self._path = av, path
        self._container: Any = av.open(str(path), "w")
        try:
            self._stream = self._container.add_stream(_ENCODER, rate=fps, options=_OPTIONS)
        except Exception as error:
            raise _failed(path, f"PyAV has no {_ENCODER}: {error}") from error
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = PIXEL_FORMAT
        self._stream.time_base = Fraction(1, fps)

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        try:
            self._container.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(picture, format="rgb24")))
        except self._av.error.FFmpegError as error:
            raise _failed(self._path, str(error)) from error

    def discard(self) -> None:
        with suppress(self._av.error.FFmpegError):
            self._container.close()

    def close(self) -> None:
        try:
            self._container.mux(self._stream.encode())
            self._container.close()
        except self._av.error.FFmpegError as error:
            raise _failed(self._path, str(error)) from error


class _FfmpegFile:
    """A file that the program ffmpeg writes; it reads the pictures from its standard input."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        program = shutil.which("ffmpeg")
        assert program is not None
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[1]}x{size[0]}", "-r", str(fps), "-i", "-"]
        options = [word for name, value in _OPTIONS.items() for word in (f"-{name}", value)]
        command = [
            program,
            "-loglevel",
            "error",
            "-y",
            *source,
            "-c:v",
            _ENCODER,
            *options,
            "-pix_fmt",
            PIXEL_FORMAT,
            str(path),
        ]
        self._path = path
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the video
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._said, env=dict([_QUIET]) | os.environ
        )

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(picture).data)
        except BrokenPipeError as error:
            raise _failed(self._path, self._reason()) from error

    def close(self) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError as error:
            raise _failed(self._path, self._reason()) from error
        if self._process.wait():
            raise _failed(self._path, self._reason())
        self._said.close()

    def discard(self) -> None:
        assert self._process.stdin is not None
        self._process.kill()
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.wait()
        self._said.close()

    def _reason(self) -> str:
        self._process.wait()
        self._said.seek(0)
        return self._said.read().decode(errors="replace")


def _failed(path: Path, reason: str) -> ConfigError:
    return ConfigError(
        f"{path}: cannot be encoded ({' '.join(reason.split())[:300]}), expected an encoder with {_ENCODER}; leave out --video",
        "video_failed",
    )


class VideoFiles:
    """Video files of one camera, one after the other; each has whole episodes.

    Args:
        folder: Folder of their folders.
        fps: Pictures a second.
        size: Height and width of the pictures, pixels.
        max_bytes: Size from which a file is followed by another one.
        chunk_files: Maximum number of files of a folder.
    """

    def __init__(self, folder: Path, fps: int, size: tuple[int, int], max_bytes: int, chunk_files: int) -> None:
        self._fps, self._size, self._max_bytes = fps, size, max_bytes
        self._numbers = FileNumbers(folder, ".mp4", chunk_files)
        self._path = folder
        self._file: VideoFile | None = None
        self._first = self._count = 0  # pictures of the file before the episode, and all

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        """Adds a picture of the episode, (H, W, 3) uint8.

        Raises:
            ConfigError: It cannot be encoded (``video_failed``).
            OSError: The folder cannot be written.
        """
        if self._file is None:
            self._path = self._numbers.advance()
            self._file, self._first, self._count = open_video(self._path, self._fps, self._size), 0, 0
        self._file.add(picture)
        self._count += 1

    def end_episode(self) -> dict[str, float]:
        """Returns where the pictures of the episode are; a file that may become too large is ended.

        Raises:
            ConfigError: The file cannot be ended (``video_failed``).
        """
        place: dict[str, float] = {
            "chunk_index": self._numbers.chunk,
            "file_index": self._numbers.file,
            "from_timestamp": self._first / self._fps,
            "to_timestamp": self._count / self._fps,
        }
        self._first = self._count
        size = self._path.stat().st_size if self._path.exists() else 0  # an encoder holds pictures back
        if size > self._max_bytes // 2:
            self.close()
        return place

    def close(self) -> None:
        """Ends the file.

        Raises:
            ConfigError: The encoder failed (``video_failed``).
        """
        if self._file is not None:
            self._file.close()
            self._file = None

    def discard(self) -> None:
        """Gives the file up."""
        if self._file is not None:
            self._file.discard()
            self._file = None
