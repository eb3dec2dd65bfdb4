"""NVIDIA's validator judges any OpenUSD file by its own rules, those of other packages left out; see README.md."""

import json
import logging
import sys

import usd_validation_nvidia as validation

OWN = validation.__name__

logging.disable(logging.CRITICAL)
engine = validation.ValidationEngine(init_rules=False)
rules = validation.CategoryRuleRegistry()
own = [rule for category in rules.categories for rule in rules.get_rules(category) if rule.__module__.startswith(OWN)]
for rule in own:
    engine.enable_rule(rule)
grave = (validation.IssueSeverity.ERROR, validation.IssueSeverity.FAILURE)
request = json.load(sys.stdin)
for file in request["files"]:
    issues = [issue for issue in engine.validate(file).issues() if issue.severity in grave]
    problems = [f"{getattr(issue.rule, '__name__', issue.rule)}: {issue.message} {issue.at}" for issue in issues]
    print("SEEN", json.dumps({"error": None if own else "no rule", "problems": problems}), flush=True)
