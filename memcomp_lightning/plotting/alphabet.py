"""Letters of the states of a category."""

import string

from memcomp_lightning.errors import require

LETTERS = string.digits + string.ascii_uppercase
"""What states are called where nobody says otherwise."""


def letters_of(n_states: int, alphabet: str | None = None) -> str:
    """A letter for each state.

    Args:
        n_states: States, >= 1.
        alphabet: Their letters in the order of their numbers; None takes digits and then capitals.

    Raises:
        SettingError: There are more states than letters.

    >>> letters_of(4, "ACGT-")
    'ACGT'
    """
    letters, remedy = LETTERS if alphabet is None else alphabet, "Give an alphabet with a letter for each state."
    require(n_states <= len(letters), "alphabet", letters, f"at least {n_states} letters", remedy)
    return letters[:n_states]
