"""Kernels: loops over the steps of a DMM, in plain torch (``reference``) or compiled for the CPU (``cpu``)."""
