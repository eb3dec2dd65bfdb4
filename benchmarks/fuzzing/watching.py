"""Watches a reader while it reads an input: what it opens, starts and connects to, how much time and memory it takes, how it ends."""

import ctypes
import os
import shutil
import struct
import sys
import sysconfig
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.mutation.odd_values import OUTSIDE, OUTSIDE_FILES
from stable_data.errors import StableDataError
from stable_data.limits import KIB

ROOT = Path(__file__).resolve().parents[2]

MOST_SECONDS = 10.0
"""Processor time of an input; more is a finding."""

MOST_MEMORY = 2 * 2**30
"""Bytes of memory that an input may take beyond what its process had before; more is a finding."""

MOST_MESSAGE = 2000
"""Characters of a message; longer ones are a finding."""

NATIVE = "native"
"""The type of an escape that Python did not report: something opened a file that no reader may open."""

_OWN = ("stable_data", "models", "pipelines")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_OF_SYSTEM = (
    "/usr/share",
    "/usr/lib",
    "/lib",
    "/etc/ld.so.cache",
    "/etc/localtime",
    "/etc/mime.types",
    "/sys/devices/system",
    "/sys/fs/cgroup",
)
_OF_PROCESS = (
    "/proc/self",
    "/proc/cpuinfo",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/mounts",
    "/dev/null",
    "/dev/urandom",
    f"/proc/{os.getpid()}",
)
_READS = {"os.listdir": 0, "os.scandir": 0, "os.chdir": 0}
_WRITES: Mapping[str, tuple[int, ...]] = {
    "os.mkdir": (0,),
    "os.rmdir": (0,),
    "os.remove": (0,),
    "os.truncate": (0,),
    "os.chmod": (0,),
    "os.chown": (0,),
    "os.utime": (0,),
    "os.rename": (0, 1),
    "os.link": (0, 1),
    "os.symlink": (1,),
}
_OF_FOLDER = frozenset({"os.mkdir", "os.rmdir", "os.remove"})  # their last argument is the open folder of a relative path
_STARTS = frozenset({"os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "os.startfile", "pty.spawn"})
_NETWORK = frozenset(
    {
        *("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "socket.sendmsg"),
        *("urllib.Request", "http.client.connect", "ftplib.connect", "smtplib.connect", "webbrowser.open"),
    }
)
_MAKES_CODE = (
    "dataclasses.py",
    "collections/__init__.py",
    "typing.py",
    "enum.py",
    "importlib",
)  # of the standard library, not of data
_IN_OPEN, _IN_MODIFY, _IN_CREATE, _IN_DELETE, _IN_MOVED = 0x20, 0x2, 0x100, 0x200, 0xC0
_IN_NONBLOCK, _EVENT = 0o4000, struct.Struct("iIII")


class FindingKind(StrEnum):
    """What is wrong with how a reader ended."""

    CRASH = "crash"
    SIGNAL = "signal"
    HANG = "hang"
    MEMORY = "memory"
    ESCAPE = "escape"
    FALSE_PASS = "false pass"  # noqa: S105 - a verdict
    MESSAGE = "message"


class FalsePass(Exception):  # noqa: N818 - it says what happened
    """A reader gave a result that it must not give, such as a verdict on numbers that are not finite."""


class _Escape(BaseException):
    """Stops a reader before it does what it must not do."""


@dataclass(frozen=True, slots=True)
class Finding:
    """An input that a reader did not end well.

    Attributes:
        kind: What is wrong.
        type: Type of the exception, name of the signal, or what was done.
        frame: The last line of this project that ran, as ``file:line function``; empty if it is not known.
        message: What the reader said, shortened.
        trace: The traceback.
    """

    kind: FindingKind
    type: str
    frame: str
    message: str
    trace: str = ""

    @property
    def key(self) -> str:
        """What makes it different from other findings of its target."""
        return f"{self.kind}, {self.type}, {self.frame}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a reader ended.

    Attributes:
        is_accepted: Whether it gave a result.
        code: The code of its refusal; empty for a result.
        finding: What is wrong; None if nothing is.
        seconds: Processor time.
    """

    is_accepted: bool
    code: str
    finding: Finding | None
    seconds: float


class Places:
    """The folders of a process: one for the inputs of each target, with one beside it that belongs to nobody, and its own ones.

    Args:
        root: A folder for all of them; it exists.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.own, self.current = self.root / "own", self.root / "current"
        for folder in (self.own / "tmp", self.own / "cache", self.current):
            folder.mkdir(parents=True, exist_ok=True)
        write_outside(Path(OUTSIDE))

    def folder(self, target: str, base: str) -> Path:
        """The folder of the files of a base."""
        return self.root / "inputs" / target / base

    def outside(self, target: str) -> Path:
        """The folder beside those of the bases of a target that no reader may look into; it is made."""
        folder = self.root / "inputs" / target / "outside"
        write_outside(folder)
        return folder

    def enter(self) -> None:
        """Makes the folders those of this process: temporary files, caches, and the current folder."""
        tempfile.tempdir = None
        os.environ |= {"TMPDIR": str(self.own / "tmp"), "XDG_CACHE_HOME": str(self.own / "cache"), "HOME": str(self.own)}
        os.chdir(self.current)

    def clear(self) -> None:
        """Removes what a reader left in the folders in which it may write: no input shall find what another one left."""
        for folder in (self.own / "tmp", self.own / "cache", self.current):
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path, ignore_errors=True)
                    else:
                        os.unlink(entry.path)  # noqa: PTH108 - called for each input


def write_outside(folder: Path) -> None:
    """Writes the files that no reader may open."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in OUTSIDE_FILES:
        path = folder / name
        if not path.exists():
            path.write_bytes(b"no reader may open this file\n")


class Watch:
    """Watches this process. There is one for each process, since an audit hook stays.

    Args:
        places: The folders of the process.
    """

    def __init__(self, places: Places) -> None:
        self._places = places
        stated = [sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
        stated += [sys.prefix, sys.base_prefix, *(str(ROOT / name) for name in (*_OWN, "benchmarks", "schemas"))]
        self._libraries = _Roots([*stated, *(str(Path(x).resolve()) for x in stated)])
        self._writable = _Roots([str(places.own), "/dev/null"])
        self._readable = _Roots([*self._libraries.roots, *self._writable.roots, *_OF_SYSTEM, *_OF_PROCESS])
        self._folder = _Roots([])
        self._starts: Collection[str] = ()
        self._escapes: list[tuple[str, str, str]] = []
        self._refused_memory = 0
        self._is_active = False
        self._own_work = threading.local()
        self._eyes = _Eyes()
        self._eyes.watch(places.current)
        self._eyes.watch(Path(OUTSIDE))
        self._note_refused_memory()
        sys.addaudithook(self._audit)

    def add_outside(self, folder: Path) -> None:
        """Watches one more folder that no reader may look into."""
        self._eyes.watch(folder)

    def run(self, read: Callable[[Path, str], bool], folder: Path, base: str, starts: Collection[str] = ()) -> Outcome:
        """Runs a reader on the files in a folder.

        Args:
            read: The reader.
            folder: The folder; the reader may read it.
            base: Name of the base, which is passed on.
            starts: Beginnings of commands that may be started.
        """
        self._escapes.clear()
        self._refused_memory, self._folder, self._starts = 0, _Roots([str(folder)]), starts
        self._eyes.drain()
        size, began = memory_size()[0], time.process_time()
        accepted, code, finding = False, "", None
        try:
            self._is_active = True
            try:
                accepted = read(folder, base)
            finally:
                self._is_active = False
        except StableDataError as error:
            code, finding = error.code, _unclear(error)
        except FalsePass as error:
            finding = _of_exception(FindingKind.FALSE_PASS, error)
        except (_Escape, KeyboardInterrupt) as error:
            finding = _of_exception(FindingKind.ESCAPE, error)
        except BaseException as error:  # noqa: BLE001 - SystemExit and pyo3's panics too: whatever a reader raises is the finding
            finding = _of_exception(FindingKind.CRASH, error)
        seconds = time.process_time() - began
        used = max(memory_size()[1] - size, self._refused_memory)
        if self._escapes:
            what, where, trace = self._escapes[0]
            finding = Finding(FindingKind.ESCAPE, what, _own_frame_of_text(trace), where, trace)
        elif seen := self._eyes.seen():
            finding = Finding(FindingKind.ESCAPE, NATIVE, "", seen)
        elif seconds > MOST_SECONDS:
            finding = Finding(FindingKind.HANG, "slow", "" if finding is None else finding.frame, f"{seconds:.1f} s")
        elif used > MOST_MEMORY:
            finding = Finding(
                FindingKind.MEMORY, "address space", "" if finding is None else finding.frame, f"{used / 2**30:.2f} GiB"
            )
        return Outcome(accepted and finding is None, code, finding, seconds)

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._is_active or getattr(self._own_work, "is_on", False):
            return
        if event == "open":
            path, _, flags = arguments
            # It does not say the folder to which the path is relative; that is one that the library has opened before.
            is_relative = not isinstance(path, int) and not os.path.isabs(path)  # noqa: PTH117 - called for each file
            is_in_open_folder = is_relative and sys._getframe(1).f_code.co_filename == shutil.__file__
            if not is_in_open_folder and not self._may(path, is_change=bool((flags or 0) & _WRITING)):
                self._escaped(event, f"{path!r:.300}, flags {flags}")
        elif event in _READS:
            place = arguments[0] or "."
            is_import = event == "os.listdir" and place in sys.path  # a library that is imported when it is needed
            if not is_import and not self._may(place, is_change=False):
                self._escaped(event, f"{arguments[0]!r:.300}")
        elif event in _WRITES:
            handle = arguments[-1] if event in _OF_FOLDER else -1  # an open folder, to which the path is relative
            for k in _WRITES[event]:
                path = arguments[k] if handle == -1 else str(Path(f"/proc/self/fd/{handle}") / os.fsdecode(arguments[k]))
                is_made = event == "os.mkdir" and Path(os.fsdecode(path)).is_dir()  # nothing changes
                if not is_made and not self._may(path, is_change=True):
                    self._escaped(event, f"{path!r:.300}")
        else:
            self._audit_code(event, arguments)

    def _audit_code(self, event: str, arguments: tuple[Any, ...]) -> None:
        """What starts, connects or runs something."""
        if event == "subprocess.Popen":
            command = " ".join(map(str, arguments[1] or ()))
            if not any(start in command for start in self._starts):
                self._escaped(event, command[:300])
        elif (event in _STARTS and not self._starts) or event in _NETWORK:
            self._escaped(event, f"{arguments!r:.300}")
        elif event == "exec":
            name, caller = getattr(arguments[0], "co_filename", ""), sys._getframe(2).f_code.co_filename
            is_known = name.startswith("<frozen") or self._libraries.hold(name)
            if not is_known and not any(part in caller for part in _MAKES_CODE):
                self._escaped(event, f"{name} by {caller}")
        elif event == "pickle.find_class" and any(f"/{part}/" in sys._getframe(2).f_code.co_filename for part in _OWN):
            self._escaped(event, f"{arguments!r:.300}")

    def _may(self, path: Any, *, is_change: bool) -> bool:
        """Whether a reader may read or change a place; an open file may be used."""
        if isinstance(path, int):
            return True
        text = os.fsdecode(path)
        if "\0" in text:
            return True  # no file has such a name
        if ".." not in text and (
            self._writable.hold(text) or (not is_change and (self._folder.hold(text) or self._readable.hold(text)))
        ):
            return True
        self._own_work.is_on = True
        try:
            real = os.path.realpath(text)
        finally:
            self._own_work.is_on = False
        return self._writable.hold(real) or (not is_change and (self._folder.hold(real) or self._readable.hold(real)))

    def _escaped(self, event: str, what: str) -> None:
        self._own_work.is_on = True
        try:
            self._escapes.append((event, what, "".join(traceback.format_stack(limit=40)[:-2])))
        finally:
            self._own_work.is_on = False
        raise _Escape(f"{event}: {what}")

    def _note_refused_memory(self) -> None:
        """Notes how much memory numpy was refused: readers may turn the error into a refusal."""
        from numpy._core._exceptions import _ArrayMemoryError

        watch, initialise = self, _ArrayMemoryError.__init__

        def noting(error: Any, shape: Any, dtype: Any) -> None:
            initialise(error, shape, dtype)
            watch._refused_memory = max(watch._refused_memory, int(error._total_size))

        _ArrayMemoryError.__init__ = noting  # type: ignore[method-assign]


class _Roots:
    """Folders and files, and what lies below them."""

    def __init__(self, roots: Collection[str]) -> None:
        self.roots = tuple(dict.fromkeys(root.rstrip(os.sep) for root in roots))
        self._below = tuple(f"{root}{os.sep}" for root in self.roots)

    def hold(self, path: str) -> bool:
        """Whether a path is one of them, or lies below one."""
        return path.startswith(self._below) or path in self.roots


class _Eyes:
    """Sees whatever opens or changes something in some folders, also native code and other processes; on Linux."""

    def __init__(self) -> None:
        self._handle = -1
        if sys.platform.startswith("linux"):
            self._library = ctypes.CDLL(None, use_errno=True)
            self._handle = self._library.inotify_init1(_IN_NONBLOCK)

    def watch(self, folder: Path) -> None:
        """Watches one more folder."""
        if self._handle >= 0:
            kinds = _IN_OPEN | _IN_MODIFY | _IN_CREATE | _IN_DELETE | _IN_MOVED
            self._library.inotify_add_watch(self._handle, os.fsencode(folder), kinds)

    def drain(self) -> None:
        """Forgets what was seen."""
        while self._events():
            pass

    def seen(self) -> str:
        """Returns what was seen, in words; empty if nothing was."""
        names = []
        while events := self._events():
            at = 0
            while at < len(events):
                _, mask, _, size = _EVENT.unpack_from(events, at)
                name = events[at + _EVENT.size : at + _EVENT.size + size].rstrip(b"\0").decode("utf-8", "replace")
                names.append(f"{name or 'a watched folder'} ({mask:#x})")
                at += _EVENT.size + size
        return ", ".join(dict.fromkeys(names))[:300]

    def _events(self) -> bytes:
        try:
            return os.read(self._handle, 65_536) if self._handle >= 0 else b""
        except BlockingIOError:
            return b""


def memory_size() -> tuple[int, int]:
    """The address space of this process, and the largest that it has had, bytes; zeros if the system does not say it."""
    try:
        with open("/proc/self/status", "rb") as status:  # noqa: PTH123 - called for each input
            text = status.read()
    except OSError:
        return 0, 0
    size, peak = (int(text[text.index(name) :].split(None, 2)[1]) * KIB for name in (b"VmSize:", b"VmPeak:"))
    return size, peak


def _unclear(error: StableDataError) -> Finding | None:
    """What is wrong with a refusal; None if it is one line of a sensible length, with a code."""
    text, wrong = str(error), ""
    if len(text) > MOST_MESSAGE:
        wrong = "long"
    elif not text.isprintable() or not text.strip():
        wrong = "no line"
    elif not isinstance(error.code, str) or not error.code or error.code in ("error", "unexpected"):
        wrong = "no code"
    if not wrong:
        return None
    return _of_exception(FindingKind.MESSAGE, error, wrong)


def check_text(text: str, code: str) -> None:
    """Refuses a notice that is no line of a sensible length, or that reports an unexpected error.

    Raises:
        FalsePass: See above.
    """
    if code == "unexpected" or "please report" in text:
        raise FalsePass(f"an unexpected error was turned into a notice: {text[:500]}")
    if len(text) > MOST_MESSAGE or not text.isprintable():
        raise FalsePass(f"a notice of {len(text)} characters: {text[:200]!r}")


def _of_exception(kind: FindingKind, error: BaseException, name: str = "") -> Finding:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if _is_own(frame.filename)]
    last = own[-1] if own else None
    frame = "" if last is None else f"{Path(last.filename).relative_to(ROOT)}:{last.lineno} {last.name}"
    trace = "".join(traceback.format_exception(error, limit=60))[-6000:]
    return Finding(kind, name or type(error).__name__, frame, str(error)[:500], trace)


def _is_own(path: str) -> bool:
    return any(path.startswith(str(ROOT / name) + os.sep) for name in _OWN)


def _own_frame_of_text(trace: str) -> str:
    """The last line of this project in a traceback that is text, of Python's own or of faulthandler's form."""
    found = ""
    for line in trace.splitlines():
        words = line.strip()
        if words.startswith("File ") and any(f"{ROOT / name}{os.sep}" in words for name in _OWN):
            path, _, rest = words.removeprefix('File "').partition('"')
            number, _, function = rest.removeprefix(", line ").partition(" in ")
            frame = f"{Path(path).relative_to(ROOT)}:{number.strip(', ')} {function.strip()}"
            if "most recent call first" in trace:
                return frame
            found = frame
    return found


def frame_of_dump(dump: str) -> str:
    """The last line of this project in what faulthandler wrote, of the thread that was running."""
    current = dump.partition("Current thread")[2] or dump
    return _own_frame_of_text("most recent call first\n" + current.partition("\n\n")[0])
