"""``memcomp-report``: figures, tables and verdicts from run folders of ``experiment=figure4`` and the like."""

from collections.abc import Sequence

from memcomp_lightning.cli import entry


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    entry.run("memcomp-report", arguments)


if __name__ == "__main__":
    main()
