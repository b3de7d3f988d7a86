"""Hydra configuration of this project; other projects reach it as ``pkg://sparse_digits.conf``."""
