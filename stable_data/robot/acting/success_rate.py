"""How sure a success rate is."""

import math

_NORMAL_95 = 1.959964  # standard deviations on both sides that hold 95 %


def wilson_interval(successes: int, attempts: int) -> tuple[float, float]:
    """Returns Wilson's 95 % interval of the probability of success; (0, 1) without attempts.

    Args:
        successes: Attempts that succeeded.
        attempts: All attempts, taken as independent of each other.

    Raises:
        ValueError: There are more successes than attempts, or a number is negative.
    """
    if not 0 <= successes <= attempts:
        raise ValueError(f"{successes} successes of {attempts} attempts, expected 0 to {attempts}")
    if not attempts:
        return 0.0, 1.0
    rate, z2 = successes / attempts, _NORMAL_95**2
    centre = (rate + z2 / (2 * attempts)) / (1 + z2 / attempts)
    half = _NORMAL_95 * math.sqrt(rate * (1 - rate) / attempts + z2 / (4 * attempts**2)) / (1 + z2 / attempts)
    return max(0.0, centre - half), min(1.0, centre + half)
