"""The configuration groups, reached by other projects as ``hydra.searchpath=[pkg://memcomp_lightning.conf]``."""
