"""Train restricted Boltzmann machines and deep belief networks, with a choice of samplers for the gradient."""

__version__ = "0.2.0"
