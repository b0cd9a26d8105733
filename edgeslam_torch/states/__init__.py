"""States of the system: `machine.py` has the table of states and events.

Every state turns a frame into a `Step` with an event: `starting.py` tracks predicted depths until there is a map,
`tracking.py` tracks the map and creates keyframes, `lost.py` relocalises and eventually starts a new submap. Shared
parts (map, motion, scale, mapping) are in `system.py`.
"""
