"""Findings are lines of a bounded length, and of one file a bounded number."""

from stable_data.verification.findings import MOST_TOLD, Finding, Findings


def test_of_one_file_the_first_findings_are_told_and_all_are_counted() -> None:
    told = list[Finding]()
    findings = Findings(told.append)
    for row in range(3 * MOST_TOLD):
        findings.damage("warnings/part-0.parquet", "is odd", row)
    findings.damage("scenes/part-0.parquet", "is odd", 7)
    assert len(told) == MOST_TOLD + 2
    assert str(told[MOST_TOLD]) == "warnings/part-0.parquet: has more than 1,000 findings; the others are counted and not shown"
    assert findings.num_damaged == {"warnings": 3 * MOST_TOLD, "scenes": 1}
