"""``memcomp-transform``: features of rows, the means of hidden units."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-transform")


if __name__ == "__main__":
    main()
