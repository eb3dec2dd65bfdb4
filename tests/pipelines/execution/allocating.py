"""Functions that allocate memory, for other processes; this module imports nothing that takes time."""

MIB = 2**20


def allocate(num_bytes: int) -> int:
    """Allocates in Python."""
    return len(bytes(bytearray(num_bytes)))


def allocate_tensor(num_bytes: int = 1) -> int:
    """Allocates with torch."""
    import torch

    return len(torch.ones(num_bytes, dtype=torch.uint8))
