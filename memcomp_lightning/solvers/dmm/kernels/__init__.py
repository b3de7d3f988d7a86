"""Kernels: loops over the steps of a DMM, plain (``reference``) or compiled for the CPU (``cpu``)."""
