"""Many recordings: each run, evaluated and reported in a process of its own, and one table of all."""
