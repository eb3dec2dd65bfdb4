"""Averages the weights of correctors that were trained one from another: the mean combines what each does better.

``python -m models.physics_corrector.training.averaging OUT FILE SHARE FILE SHARE ...``; the notes in the file, such as the encoder,
are those of the last one.
"""

import sys
from pathlib import Path

from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.training.averaging import average_states
from stable_data.errors import ConfigError


def main(out: str, *rest: str) -> None:
    """Writes the mean of some correctors.

    Raises:
        ConfigError: A file cannot be read, the networks differ, or they read the features of different encoders
            (``checkpoint_mismatch``).
    """
    if not rest or len(rest) % 2:
        raise ConfigError("expected OUT FILE SHARE FILE SHARE ...", "config_invalid")
    files, shares = rest[::2], [float(share) for share in rest[1::2]]
    found = [load_corrector(Path(file).expanduser()) for file in files]
    last = found[-1]
    for file, one in zip(files, found, strict=True):
        encoders = [{k: v for k, v in each.notes.items() if k.endswith("encoder_fingerprint")} for each in (one, last)]
        if differences := one.settings.differences(last.settings):
            raise ConfigError(f"{file}: has another network ({'; '.join(differences)})", "checkpoint_mismatch")
        if encoders[0] != encoders[1]:
            raise ConfigError(f"{file}: reads the features of another encoder", "checkpoint_mismatch")
    states = average_states([one.network.state_dict() for one in found], shares)
    save_corrector(Path(out), last.settings, states, {**last.notes, "mean_of": " ".join(rest[1::2])})


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except ConfigError as error:
        raise SystemExit(str(error)) from error
