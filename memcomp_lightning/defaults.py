"""Settings that a first user gets, whether in Python, from scikit-learn or on the command line.

Chosen on held-out data: experiments/defaults. A test holds the files of ``conf`` against them.
"""

BATCH_SIZE = 20
"""Samples an update, in pretraining and in fine-tuning."""

PASSES = 10
"""Passes over the training set for an RBM."""

LEARNING_RATE = 0.05
"""Of an RBM, by plain gradient descent."""

N_CHAINS = 100
"""Persistent chains."""

CENTRING_RATE = 0.01
"""Weight of the newest update in the centres of the units."""

WEIGHT_STD = 0.01
"""Standard deviation of the first weights."""

FINETUNING_PASSES = 50
"""Passes over the training set of back-propagation."""

FINETUNING_LEARNING_RATE = 0.2
"""Of back-propagation."""

FINETUNING_MOMENTUM = 0.9
"""Of back-propagation."""
