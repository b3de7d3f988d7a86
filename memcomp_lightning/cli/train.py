"""``memcomp-train``: pretrain, fine-tune, evaluate."""

from memcomp_lightning.cli import entry


def main() -> None:
    """Entry point."""
    entry.run("memcomp-train")


if __name__ == "__main__":
    main()
