"""The judge: every recording, its variants and a dozen simulated flights, each in its own process, as one table."""
