"""``memcomp-sample``: rows drawn from a trained model."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-sample")


if __name__ == "__main__":
    main()
