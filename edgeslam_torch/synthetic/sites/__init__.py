"""Worlds to fly by: rooms and corridors with a start, a goal, and exits known from geometry."""
