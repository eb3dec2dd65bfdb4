"""Audits every scene of a folder in the MesaTask-10K format exactly, and names the objects that collide or float.

python -m examples.audit_folder FOLDER
"""

import sys
from pathlib import Path

import stable_data as sd


def main(folder: Path) -> None:
    """Prints one line for each scene that is not clean, then the summary of the folder.

    Args:
        folder: It holds Layout_info, Asset_annotation.json and Assets_library.
    """
    result = sd.lint_folder(folder, progress=False)
    for row in result.rows:
        deeper = [p for p in row["pairs"] if (p["penetration_mm"] or 0.0) > 0.5]  # null is unknown; the summary counts it
        colliding = [f"{p['first']} and {p['second']}" for p in deeper]
        floating = [v["instance"] for v in row["verdicts"] if v["floats"]]
        if colliding or floating:
            print(f"{row['scene_id']}: colliding {colliding}, floating {floating}")
    for notice in result.failures:
        print(f"{notice.item_id}: {notice.message}")  # a scene that could not be read or judged
    print(result)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
