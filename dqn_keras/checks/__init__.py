"""Checks of the input of public functions: numbers, batches, networks, environments."""
