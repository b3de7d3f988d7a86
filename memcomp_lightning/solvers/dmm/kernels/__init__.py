"""Kernels: loops over the steps of a DMM, in plain array operations (``reference``) or compiled for the CPU (``cpu``)."""
