"""What a format of exported models must offer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from memcomp_lightning.trained.run import Run

CLASSIFIER, FEATURES, MODEL = "classifier", "features", "model"
"""What is exported: the fine-tuned network, the means of the hidden units, or all there is."""


@dataclass(frozen=True)
class Written:
    """What a file holds, in words.

    Attributes:
        holds: Of what the file is.
        inputs: What it is given; empty for files of parameters.
        outputs: What it returns; empty for files of parameters.
        check: What was compared after writing, and how far it was apart.
        use: A line that uses the file; empty where its library says how.
    """

    holds: str
    inputs: str = ""
    outputs: str = ""
    check: str = ""
    use: str = ""


class Write(Protocol):
    """Writes a run to a file."""

    def __call__(self, run: Run, path: Path, what: str) -> Written:
        """Write, and compare what was written with the run.

        Args:
            run: A trained run.
            path: The file, which is written whole or not at all.
            what: One of the format's ``what``.

        Raises:
            UserError, SettingError: The run has no such thing, or the file could not hold it.
        """


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        purpose: What is in such a file, in a few words.
        endings: Names of its files end in one of these.
        what: What it can hold; of a run that has several, the first that it has.
        packages: Names that must be importable, which are those of pip, too.
        write: Writes it.
    """

    purpose: str
    endings: tuple[str, ...]
    what: tuple[str, ...]
    packages: tuple[str, ...]
    write: Write
