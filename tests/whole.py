"""Whether verify finds a run whole: each job's own tests ask it of a run that they have made."""

from pathlib import Path

from stable_data.storage.run_folder import RunFolder
from stable_data.verification.verifier import Verdicts, Verification, VerifyOptions, verify_run


def check_whole(run: str | Path, *, verdicts: Verdicts = "all") -> Verification:
    """Verifies a run with all of its verdicts."""
    told = list[str]()
    options = VerifyOptions(sample=0, verdicts=verdicts)
    result = verify_run(RunFolder(str(run)), lambda finding: told.append(str(finding)), options)
    assert (result.is_whole, told) == (True, []), str(result)
    return result
