"""Readers of recordings: each brings one source's raw files into the conventions of `ntop`."""
