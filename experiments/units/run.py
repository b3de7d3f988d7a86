"""Models of units of every kind beside known couplings, known densities, known minima, and loops by hand.

python experiments/units/run.py                     # all parts; the README has their times
python experiments/units/run.py --only speed ising  # some of them
python experiments/units/run.py --quick             # small cases in a minute, to try it; writes nothing
python experiments/units/run.py --table             # prints the tables as they stand
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent))

import parts  # noqa: E402

PARTS = ["speed", "mixture", "ising", "ground_states", "sequences"]

if __name__ == "__main__":
    parts.main(__doc__, PARTS, HERE)
