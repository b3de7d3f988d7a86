"""Default settings, the same in Python, in scikit-learn and on the command line.

They were chosen on held-out data: experiments/defaults. A test checks that the files of ``conf`` agree with them.
"""

BATCH_SIZE = 20
"""Samples an update, in pretraining and in fine-tuning."""

PASSES = 10
"""Passes over the training set for an RBM."""

LEARNING_RATE = 0.05
"""Of an RBM, by plain gradient descent."""

TABLE_BATCH_SIZE = 100
"""Samples an update of an RBM of a table: of ``data=table`` and ``MemcompRBM``; chosen in experiments/density."""

TABLE_LEARNING_RATE = 0.1
"""Of its first update."""

TABLE_LAST_RATE = 0.01
"""Share of it in the last pass, to which it falls linearly."""

TABLE_UPDATES = 10_000
"""Updates, where no passes are given; there are ten passes at least."""

TABLE_MOST_PASSES = 200
"""Passes where no rows are held out that would tell when a model learns its rows by heart."""

TABLE_HIDDEN = 128
"""Hidden units."""

TABLE_LADDERS, TABLE_TEMPERATURES = 20, 5
"""Of parallel tempering, its negative phase: a hundred states in all."""

N_CHAINS = 100
"""Persistent chains."""

CENTRING_RATE = 0.01
"""Weight of the newest update in the centres of the units."""

WEIGHT_STD = 0.01
"""Standard deviation of the first weights."""

FINETUNING_PASSES = 50
"""Passes over the training set of back-propagation."""

FINETUNING_LEARNING_RATE = 0.2
"""Learning rate of back-propagation."""

FINETUNING_MOMENTUM = 0.9
"""Momentum of back-propagation."""
