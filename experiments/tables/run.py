"""Tables, sequences and their commands, beside known distributions and other methods.

python experiments/tables/run.py                       # all parts; the README has their times
python experiments/tables/run.py --only genotypes      # some of them
python experiments/tables/run.py --quick               # small cases, to try it; writes nothing
python experiments/tables/run.py --table               # prints the tables as they stand
"""

import sys
from pathlib import Path

import torch

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent))

import parts  # noqa: E402

PARTS = ["genotypes", "mixed", "alignments", "scale"]

if __name__ == "__main__":
    torch.set_num_threads(1)
    parts.main(__doc__, PARTS, HERE)
