"""What the figures have in common: colours, and names that fit."""

DATA, SAMPLES, HELDOUT, FOURTH = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
"""Okabe and Ito's colours, which colour-blind readers tell apart; they differ in lightness, too."""


def shortened(text: str, longest: int) -> str:
    """A text that fits: what differs may stand at its end, so the middle goes.

    >>> shortened("temperature in room 12", 10)
    'temper… 12'
    """
    if len(text) <= longest:
        return text
    end = (longest - 1) // 3
    return f"{text[: longest - 1 - end]}…{text[-end:]}"
