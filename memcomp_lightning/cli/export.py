"""``memcomp-export``: a trained run for other programs."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-export")


if __name__ == "__main__":
    main()
