"""Settings of training by likelihood that the estimators and the configuration share."""

BATCH_SIZE = 20
"""Samples an update."""

LEARNING_RATE = 0.05
"""Of plain gradient descent."""

N_CHAINS = 100
"""Persistent chains."""

CENTRING_RATE = 0.01
"""Weight of the newest update in the centres of the units."""

WEIGHT_STD = 0.01
"""Standard deviation of the first weights."""
