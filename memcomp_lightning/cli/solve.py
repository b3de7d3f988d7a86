"""``memcomp-solve``: look for the minimum of a problem that stands in a file."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-solve")


if __name__ == "__main__":
    main()
