"""Detection of exits (door-like openings) and pathways (corridors) in free space."""
