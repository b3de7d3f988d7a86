"""What trains many networks and compares them: trials, records, choices, results, verdicts, reports."""

from memcomp_lightning.studies.accuracy import Member, Unit, run_unit
from memcomp_lightning.studies.likelihood import Job, run_job
from memcomp_lightning.studies.page import Section, markdown, page
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.studies.records import Record, Records
from memcomp_lightning.studies.results import Claim, FigurePlan, Results, read_results
from memcomp_lightning.studies.verdicts import Verdict, verdicts

__all__ = [
    "Claim",
    "FigurePlan",
    "Job",
    "Member",
    "Plan",
    "Record",
    "Records",
    "Results",
    "Section",
    "Stage",
    "Unit",
    "Verdict",
    "markdown",
    "page",
    "read_results",
    "run_job",
    "run_unit",
    "verdicts",
]
