"""Text tables."""

from collections.abc import Sequence


def align_columns(rows: Sequence[Sequence[str]], num_left: int) -> str:
    """Joins rows of cells with aligned columns, the first ``num_left`` of them to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(w) if k < num_left else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )
