"""A sparse RBM of handwritten digits, made of parts of memcomp_lightning and its own."""
