"""``memcomp-impute``: fill the gaps of a table."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-impute")


if __name__ == "__main__":
    main()
