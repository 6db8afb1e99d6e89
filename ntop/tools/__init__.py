"""Verbs beside the eight stages: fetching data, checking, planning."""
