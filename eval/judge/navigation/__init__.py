"""Flights through simulated worlds in lockstep, scored by ground truth, never by the drone's own map."""
