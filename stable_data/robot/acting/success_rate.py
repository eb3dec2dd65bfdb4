"""How sure a success rate is."""

from scipy.stats import binomtest


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
    found = binomtest(successes, attempts).proportion_ci(method="wilson")
    return float(found.low), float(found.high)
