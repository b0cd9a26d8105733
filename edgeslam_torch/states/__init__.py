"""States of the system: `machine.py` has the table of states and events.

Every state turns a frame into a `Step` with an event: `starting.py` tracks predicted depths until there is a map, and
starts a new submap after a loss; `tracking.py` tracks the map, creates keyframes, and relocalises lost frames. Shared
parts (map, motion, scale, mapping) are in `system.py`.
"""
