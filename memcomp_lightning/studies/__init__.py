"""What trains many networks and compares them: trials, records, choices, results, verdicts, reports."""

from memcomp_lightning.studies.accuracy import AccuracyTrial, SideBySide, grouped
from memcomp_lightning.studies.likelihood import LikelihoodTrial
from memcomp_lightning.studies.page import Section, markdown, page
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.studies.records import Record, Records, best
from memcomp_lightning.studies.results import Claim, FigurePlan, Results, read_results
from memcomp_lightning.studies.runner import runner
from memcomp_lightning.studies.verdicts import Verdict, verdicts

__all__ = [
    "AccuracyTrial",
    "Claim",
    "FigurePlan",
    "LikelihoodTrial",
    "Plan",
    "Record",
    "Records",
    "Results",
    "Section",
    "SideBySide",
    "Stage",
    "Verdict",
    "best",
    "grouped",
    "markdown",
    "page",
    "read_results",
    "runner",
    "verdicts",
]
