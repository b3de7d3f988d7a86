"""``memcomp-score``: how likely the rows of a table are."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-score")


if __name__ == "__main__":
    main()
