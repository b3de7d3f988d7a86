"""Kernels: programs that integrate a vector field, one file a device or compiler."""
