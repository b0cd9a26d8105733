"""Batches of recordings: each is run, evaluated and reported in its own process; one table of all."""
