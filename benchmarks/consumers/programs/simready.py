"""SimReady's validator judges packages by the profile Robotics-Prop; see README.md."""

import json
import logging
import sys

from simready.validate import api

PROFILE, VERSION = "Robotics-Prop", "4.0.0"

logging.disable(logging.WARNING)
api.initialize([], [], [])
request = json.load(sys.stdin)
for file in request["files"]:
    result = api.validate_asset(api.AssetValidationConfig(file, PROFILE, VERSION))
    if result is None:
        seen: dict[str, object] = {"error": f"the profile {PROFILE} {VERSION} does not apply"}
    else:
        problems = [f"{issue.requirement}: {issue.message}" for issue in result.issues]
        if not problems and not api.features_summary_passed(result.features_summary):
            problems = ["the profile is not passed"]
        seen = {"error": None, "problems": problems}
    print("SEEN", json.dumps(seen), flush=True)
