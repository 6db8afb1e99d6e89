"""Verbs beside the eight stages: fetching data, leasing GPUs, looking after a run."""
