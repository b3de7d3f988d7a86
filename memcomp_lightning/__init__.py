"""Restricted Boltzmann machines and deep belief networks whose negative phase is a swappable part."""

__version__ = "0.2.0"
