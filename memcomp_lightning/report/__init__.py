"""From what was measured for a figure to its curves, tables and verdicts."""

from memcomp_lightning.report.page import Section, markdown, page
from memcomp_lightning.report.records import Record, Records
from memcomp_lightning.report.results import Claim, Plan, Results, read_results
from memcomp_lightning.report.verdicts import Verdict, verdicts

__all__ = [
    "Claim",
    "Plan",
    "Record",
    "Records",
    "Results",
    "Section",
    "Verdict",
    "markdown",
    "page",
    "read_results",
    "verdicts",
]
