"""Perception: states for the planner from frames and state messages, metric and in the drone's world."""
