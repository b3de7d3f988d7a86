"""Default settings, the same in Python, in scikit-learn and on the command line.

They were chosen on held-out data: experiments/defaults. A test checks that the files of ``conf`` agree with them.
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
"""Learning rate of back-propagation."""

FINETUNING_MOMENTUM = 0.9
"""Momentum of back-propagation."""
