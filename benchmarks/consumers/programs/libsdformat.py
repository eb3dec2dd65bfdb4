"""libsdformat checks SDFormat as ``ign sdf --check`` does, which calls the same function of the library; see README.md."""

import ctypes
import json
import os
import sys
import tempfile
from ctypes.util import find_library

LIBRARY, C = ctypes.CDLL(find_library("sdformat12")), ctypes.CDLL(None)


def problems(path: str) -> list[str]:
    """What the library says against a file; it writes to the standard streams."""
    said = []
    kept = [os.dup(stream) for stream in (1, 2)]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        os.dup2(out.fileno(), 1)
        os.dup2(errors.fileno(), 2)
        try:
            status = LIBRARY.cmdCheck(path.encode())
            C.fflush(None)
        finally:
            for stream, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
        for file in (out, errors):
            file.seek(0)
            said.append([line for line in file.read().decode().splitlines() if line.strip()])
    verdict, found = said
    return found if status == 0 and verdict == ["Valid."] else [*found, f"not valid: {' '.join(verdict)}"]


if find_library("sdformat12") is None:
    sys.exit("libsdformat is missing")
request = json.load(sys.stdin)
for file in request["files"]:
    print("SEEN", json.dumps({"error": None, "problems": problems(file)}), flush=True)
