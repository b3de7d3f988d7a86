"""What is said of rows that were drawn: how, and how far they can be trusted."""

from dataclasses import dataclass
from typing import NamedTuple


class Exchanges(NamedTuple):
    """How the ladders of parallel tempering worked.

    Attributes:
        n_temperatures: Steps of a ladder.
        beta_hottest: Inverse temperature of the hottest one, over that of the model.
        swap_rate: Accepted share of exchanges between the two neighbours that exchange least.
        round_trips: Journeys of a state from the coldest to the hottest and back, a ladder.
    """

    n_temperatures: int
    beta_hottest: float
    swap_rate: float
    round_trips: float


@dataclass(frozen=True)
class Mixing:
    """How rows were drawn, and how far they can be trusted.

    Attributes:
        method: ``exact``, ``gibbs`` or ``tempering``.
        n_drawn: Rows that were drawn, without those that had no gaps.
        r_hat: Largest R-hat over what was watched; 1 where all chains agree.
        autocorrelation: Longest integrated autocorrelation time, in sweeps; 1 for independent states.
        effective: Independent rows that these are worth.
        n_sweeps: Sweeps of each chain in all; of a ladder, at each temperature.
        warning: What is wrong, and what to do; None if the chains mix.
        reason: Why this method.
        exchanges: Of parallel tempering.
    """

    method: str
    n_drawn: int
    r_hat: float
    autocorrelation: float
    effective: float
    n_sweeps: int
    warning: str | None = None
    reason: str | None = None
    exchanges: Exchanges | None = None

    @classmethod
    def of_independent(cls, n: int, reason: str) -> "Mixing":
        """Of n independent rows."""
        return cls("exact", n, 1.0, 1.0, float(n), 0, reason=reason)

    def lines(self) -> list[str]:
        """A few lines for people."""
        names = {"exact": "exact, independent rows", "gibbs": "Gibbs chains", "tempering": "parallel tempering"}
        found = [f"method           {names[self.method]}" + (f": {self.reason}" if self.reason else "")]
        if self.method != "exact":
            found += [
                f"autocorrelation  {self.autocorrelation:.3g} sweeps, of {self.n_sweeps:,} in all",
                f"R-hat            {self.r_hat:.3f}",
                f"effective        {self.effective:,.0f} of {self.n_drawn:,} rows",
            ]
        if self.exchanges is not None:
            found.append(
                f"exchanges        {self.exchanges.n_temperatures} temperatures down to beta = "
                f"{self.exchanges.beta_hottest:.2g}, {self.exchanges.swap_rate:.0%} accepted or more, "
                f"{self.exchanges.round_trips:.3g} round trips a ladder"
            )
        return found
