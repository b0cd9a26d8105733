"""Flights through named worlds in lockstep, judged on what is really there, never by the drone's own map."""
